"""Phase gate: an event stays only when it comes soon after the laser edge that can cause it.

ON events follow rising edges and OFF events falling ones; background does not care. Of background
of both polarities a share of (LEAD_US + gate) / period is left, 8 % at 70 Hz with 1 ms.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import whole
from eschorty_ros.core.modulation import _phase_gate as kernels
from eschorty_ros.core.modulation.modulation import Modulation

LEAD_US = 200
"""How long before the edge the window opens: an estimated edge lies behind the first events."""

GATE_MAX_US = 100_000


def gate_parameters(modulation: Modulation, gate_us: int) -> NDArray[np.float64]:
    """Return what the compiled test needs to know.

    Parameters
    ----------
    modulation : Modulation
        A sine has no edges and is not gated.
    gate_us : int
        How long after each edge events are kept, 0 to 100 000 us; 0 is no gate.

    Returns
    -------
    ndarray of float64, shape (5,)
        The last entry is 0 where nothing is to be removed: no gate, no edges, or windows that
        cover the whole period.

    Raises
    ------
    ArgumentError
        When ``gate_us`` lies outside its range.
    """
    whole("gate_us", gate_us, 0, GATE_MAX_US)
    gate = np.zeros(kernels.G_SIZE)
    period_us = modulation.period_us
    length_us = LEAD_US + gate_us
    if gate_us and modulation.waveform != "sine" and length_us < period_us:
        gate[kernels.G_PERIOD] = period_us
        gate[kernels.G_INVERSE] = 1.0 / period_us
        gate[kernels.G_ON] = LEAD_US
        gate[kernels.G_OFF] = LEAD_US - modulation.duty * period_us
        gate[kernels.G_LENGTH] = length_us
    return gate
