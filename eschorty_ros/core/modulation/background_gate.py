"""The phase gate of a stream in which background hides the line, from its first events.

The rows from which a gate is learned are not the line's where a lamp that flickers gives more
events in the window of a line than the line does.
"""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.modulation.fullest_rows import NEAR_ROWS, fullest_rows
from eschorty_ros.core.modulation.held_events import Arrays, sample
from eschorty_ros.core.modulation.modulation import Modulation
from eschorty_ros.core.modulation.phase_gate import GATE_LEARNED, LEAD_US

# The longest gate is a quarter of the period, each further one half as long.
_LENGTHS = 4
# Variance of background over that of a line, which is half as wide as its window.
_VARIANCE = 4.0
# Share of a row's variance that is background's from which on it hides the line.
_HIDES = 1.0 / 3.0
# Events that are looked at, evenly spread.
_SAMPLE = 1 << 20


def background_gate_us(
    events: Arrays, edge_us: int, modulation: Modulation, window_rows: float
) -> int:
    """Return the gate's length, or `GATE_LEARNED` where background does not hide the line.

    It is the one with which rows have the least variance.

    - ``events``: Those of the first periods, whole ones.
    - ``edge_us``: A rising edge of the laser.
    - ``window_rows``: Rows in which a line is looked for.
    """
    period_us = modulation.period_us
    longest_us = period_us / 4.0
    if modulation.waveform == "sine" or longest_us < LEAD_US:
        return GATE_LEARNED
    t_us, column, row, polarity = sample(events, _SAMPLE)
    cell, near, far_rows = fullest_rows(column, row)
    if far_rows == 0:
        return GATE_LEARNED
    phase = (t_us - edge_us + LEAD_US) / period_us - modulation.duty * (polarity == 0)
    after_us = (phase - np.floor(phase)) * period_us
    lengths_us = [GATE_LEARNED, *(round(longest_us / 2**k) for k in range(_LENGTHS))]
    cells, weights = int(cell.max()) + 1, np.empty(0)
    variances: list[float] = []
    for length_us in lengths_us:
        inside = after_us < (period_us if length_us == GATE_LEARNED else LEAD_US + length_us)
        per_row = np.bincount(cell[inside & ~near], minlength=cells) / far_rows
        line = np.bincount(cell[inside & near], minlength=cells) - NEAR_ROWS * per_row
        if not variances:
            # Dark columns do not count.
            weights = np.maximum(line, 0.0)
        of_line = max(float(weights @ line), 1.0)
        of_background = _VARIANCE * window_rows * float(weights @ per_row)
        if not variances and of_background < _HIDES * (of_line + of_background):
            return GATE_LEARNED
        variances.append((of_line + of_background) / of_line**2)
    return lengths_us[int(np.argmin(variances))]
