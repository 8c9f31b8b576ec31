"""Phase gate: an event is kept only soon after the laser edge that can cause it.

ON events follow rising edges and OFF events falling ones; background is spread evenly. The gate
keeps a share of (LEAD_US + gate) / period of the background of both polarities, 8 % at 70 Hz with
1 ms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.base.numbers import integer
from eschorty_ros.core.modulation.modulation import Modulation

LEAD_US = 200
"""Time from opening to edge: an estimated edge is later than the first events."""

GATE_MAX_US = 100_000


class PhaseGate(NamedTuple):
    """Windows behind the laser's edges in which events are kept.

    Attributes
    ----------
    period_us, frequency_mhz : float
        Length of the period and its reciprocal.
    on_lead_us, off_lead_us : float
        Time since the opening of the window of ON and of OFF events minus that since the rising
        edge.
    length_us : float
        Length of a window; 0 is no gate.
    """

    period_us: float = 1.0
    frequency_mhz: float = 1.0
    on_lead_us: float = 0.0
    off_lead_us: float = 0.0
    length_us: float = 0.0


def phase_gate(modulation: Modulation, gate_us: int) -> PhaseGate:
    """Return the windows behind the edges of ``modulation``.

    Parameters
    ----------
    modulation : Modulation
        A sine has no edges and is not gated.
    gate_us : int
        Time after each edge in which events are kept, 0 to 100 000 us; 0 is no gate.

    Returns
    -------
    PhaseGate
        No gate where the windows cover the period.

    Raises
    ------
    ArgumentError
        When ``gate_us`` is outside its range.
    """
    integer("gate_us", gate_us, 0, GATE_MAX_US)
    period_us, length_us = modulation.period_us, float(LEAD_US + gate_us)
    if gate_us == 0 or modulation.waveform == "sine" or length_us >= period_us:
        return PhaseGate()
    on_lead_us = float(LEAD_US)
    off_lead_us = on_lead_us - modulation.duty * period_us
    return PhaseGate(period_us, 1.0 / period_us, on_lead_us, off_lead_us, length_us)


@kernel
def _outside(dt_us, polarity, gate):
    """Return true when ``dt_us`` after a rising edge is outside the window of its polarity."""
    late_us = dt_us + (gate.on_lead_us if polarity else gate.off_lead_us)
    late_us -= gate.period_us * np.floor(late_us * gate.frequency_mhz)
    return late_us >= gate.length_us
