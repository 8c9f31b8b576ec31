"""How much later than the light a line's events are, from the stream itself.

Pixels answer both edges of the laser late, and a line that moves while it is lit gives its events
in between. A row is the mean over all of them, so it is where the line was in the middle of the
light: turned round in time, the same motion gives the same pixels as many events. The events' mean
time is later by what the pixels need, which is the same for all columns but for their noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.modulation import Modulation

# Before so many points their mean time is not known to a sixteenth of its scatter.
_POINTS_MIN = 256.0
# A larger one, us or share of the period, is an error of the phase.
_DELAY_MAX_US = 1000.0
_DELAY_MAX_SHARE = 0.25


class Delay(NamedTuple):
    """Sum of the points' mean times since their edge, us, and their number.

    ``middle_us`` is the middle of a profile's light; of a larger delay than ``max_us``, as by
    default, nothing is known.
    """

    sums: NDArray[np.float64]
    middle_us: float = 0.0
    max_us: float = -1.0


def empty_delay() -> Delay:
    """Return no points."""
    return Delay(np.zeros(2))


def profile_delay(before: Delay, modulation: Modulation, every: int) -> Delay:
    """Return ``before`` for profiles of ``every`` periods."""
    period_us = modulation.period_us
    return before._replace(
        middle_us=modulation.middle_us + 0.5 * (every - 1) * period_us,
        max_us=max(_DELAY_MAX_US, _DELAY_MAX_SHARE * period_us),
    )


@kernel
def _delay_us(rows, delay):
    """Add the points of a profile and return the delay of the events, us; 0 while it is unknown."""
    sums = delay.sums
    returns, columns = rows.row.shape
    for k in range(returns):
        for c in range(columns):
            if not np.isnan(rows.row[k, c]):
                sums[0] += rows.mean_dt_us[k, c]
                sums[1] += 1.0
    late_us = sums[0] / max(sums[1], 1.0) - delay.middle_us
    known = sums[1] >= _POINTS_MIN and abs(late_us) <= delay.max_us
    return np.int64(np.rint(late_us)) if known else np.int64(0)
