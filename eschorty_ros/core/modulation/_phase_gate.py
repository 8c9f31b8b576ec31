"""Compiled test whether an event comes soon after the laser edge of its polarity."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.kernel import kernel

# gate, float64: period (us) and one over it, what to add to an ON and an OFF event's time within
# the period so that its window begins at 0, and the window's length; a length of 0 is no gate
G_PERIOD, G_INVERSE, G_ON, G_OFF, G_LENGTH, G_SIZE = 0, 1, 2, 3, 4, 5


@kernel
def _outside(dt_us, polarity, gate):
    """Whether ``dt_us`` after a rising edge lies outside the window of its polarity."""
    late = dt_us + (gate[G_ON] if polarity else gate[G_OFF])
    late -= gate[G_PERIOD] * np.floor(late * gate[G_INVERSE])
    return late >= gate[G_LENGTH]
