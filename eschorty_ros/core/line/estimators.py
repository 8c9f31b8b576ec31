"""Row of the line from the events of a window or a column: mean, median, edges, likelihood."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.window import FRACTION, ROW_LAST, ROW_MASK, _limits

FWHM_PER_SIGMA = 2.3548200450309493
HALF_WIDTH_PER_FWHM = 1.3
# A window's half width in standard deviations of the line, fixed point.
HALF_PER_SIGMA = HALF_WIDTH_PER_FWHM * FWHM_PER_SIGMA * FRACTION
_EM_ITERATIONS = 4
_WEIGHT_ONE = 1 << 20
# Reach of the likelihood in half widths of a window: 4.3 standard deviations.
_REACH = 1.4
_EDGE_PART = 8


@kernel
def _mean(window):
    """Return the mean row of a window's events."""
    events = window.sums.events
    return (events * window.first + window.sums.d) / events


@kernel
def _variance(sums):
    """Return the sample variance; the numerator is an exact integer, so a constant column has 0."""
    n = sums.events
    if n < 2:
        return 0.0
    return (n * sums.d2 - sums.d * sums.d) / (float(n) * (n - 1))


@kernel(_nrt=False)
def _median(packed, column, counts):
    """Return the middle row, or the mean of the two middle rows; ``counts`` is zeroed scratch."""
    n = column.events
    low = np.int64(ROW_LAST)
    high = np.int64(0)
    for i in range(column.start, column.start + n):
        row = np.int64(packed[i] & ROW_MASK)
        counts[row] += 1
        low = min(low, row)
        high = max(high, row)
    below = np.int64(0)
    lower = np.int64(-1)
    upper = np.int64(-1)
    for middle in range(low, high + 1):
        row = np.int64(middle)
        below += counts[row]
        counts[row] = 0
        if lower < 0 and 2 * below >= n:
            lower = np.int64(row)
        if upper < 0 and 2 * below > n:
            upper = np.int64(row)
    return (lower + upper) / 2.0


@kernel(_nrt=False)
def _quantile_edge(counts, low, high, step, total):
    """Return the row up to which, from ``low`` on, there are ``total / _EDGE_PART`` events.

    The events of a row are spread evenly over its pixel, half a row to either side. A quantile that
    may be anywhere between two rows with events is put in the middle.
    """
    before = np.int64(0)
    row = low
    while True:
        here = counts[row]
        if _EDGE_PART * (before + here) >= total and here > 0:
            break
        before += here
        row += step
    if _EDGE_PART * (before + here) > total:
        return row + step * ((total / _EDGE_PART - before) / here - 0.5)
    other = row + step
    while other != high and counts[other] == 0:
        other += step
    return (row + other) / 2.0


@kernel(_nrt=False)
def _edge_midpoint(packed, column, low, high, counts):
    """Return the middle between the first and the last eighth of the events of rows low..high."""
    total = np.int64(0)
    for i in range(column.start, column.start + column.events):
        row = np.int64(packed[i] & ROW_MASK)
        if low <= row <= high:
            counts[row] += 1
            total += 1
    below = _quantile_edge(counts, low, high, 1, total)
    above = _quantile_edge(counts, high, low, -1, total)
    counts[low : high + 1] = 0
    return (below + above) / 2.0


def likelihood_size(half: int) -> int:
    """Return the entries of the likelihood's table for windows of ``half`` and narrower."""
    return int(np.ceil(_REACH * half)) + FRACTION


@kernel(_nrt=False)
def _fill_likelihood(table, half):
    """Fill ``exp(d^2 / 2 sigma^2)`` for distances of 0, 1, 2... fixed-point steps from the line.

    ``sigma`` is that of a line whose window has the half width ``half``. Returns the number of
    entries.
    """
    size = np.int64(np.ceil(_REACH * half)) + FRACTION
    scale = 0.5 * (HALF_PER_SIGMA / (FRACTION * half)) ** 2
    for d in range(size):
        table[d] = np.exp(scale * (d * d))
    return size


@kernel(_nrt=False)
def _gauss_ml(packed, column, window, first, last, half, rows, table):
    """Return the row of greatest likelihood for a Gaussian of known width on uniform background.

    Expectation-maximisation of the row and the background's share, from the window's mean on, over
    the events of rows first..last within reach. The weights are integers and depend on distances in
    fixed point: the sums are exact.
    """
    start, n = column.start, column.events
    centre = window.centre
    line = float(window.sums.events)
    per_row = np.sqrt(2.0 * np.pi) * half / (HALF_PER_SIGMA * rows)
    reach = np.int64(_REACH * half)
    low, high = _limits(centre, reach, first, last)
    shift = 0.0
    for _ in range(_EM_ITERATIONS):
        centre += np.int64(np.rint(shift))
        odds = (n - line) / line * per_row
        weights = np.int64(0)
        weighted = np.int64(0)
        for i in range(start, start + n):
            row = np.int64(packed[i] & ROW_MASK)
            if low <= row <= high:
                d = row * FRACTION - centre
                w = np.int64(_WEIGHT_ONE / (1.0 + odds * table[min(abs(d), table.size - 1)]))
                weights += w
                weighted += w * d
        weights = max(weights, np.int64(1))
        line = max(weights / _WEIGHT_ONE, 1.0)
        shift = weighted / weights
    return (centre + shift) / FRACTION
