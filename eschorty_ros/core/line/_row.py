"""Compiled estimates of the line's row from the events of a column or a window, and their sigma."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line._sigma import _sigma2
from eschorty_ros.core.line._window import (
    FRACTION,
    ROW_LAST,
    ROW_MASK,
    _limits,
)

# A window's half width in standard deviations of the line: 1.3 x FWHM, fixed point.
HALF_PER_SIGMA = 1.3 * 2.3548200450309493 * FRACTION
EM_ITERATIONS = 4
_WEIGHT_ONE = 1 << 20
# Reach of the likelihood in half widths of a window: 4.3 standard deviations.
_REACH = 1.4
_EDGE_PART = 8
_CUT_ITERATIONS = 30
# Relative variance of a flat line's sample variance, times its count. A cut line whose variance
# is one such standard deviation below what is to be expected is narrower than the window's.
_SCATTER = 1.0
# A column with more than this many times the line's variance holds stray events.
_STRAY_FREE = 2.0
# Square of the least factor on s/sqrt(N): a fit to part of a line amplifies what counts vary.
_CUT_FACTOR2 = 0.24**2
# Bias of the mean of half a Gaussian, squared, over the variance of that half.
_CUT_BIAS2 = 1.7519


class Row(NamedTuple):
    """A row, its variance, and whether the edge of the sensor cuts the line."""

    row: float
    sigma2: float
    cut: bool


class Uncut(NamedTuple):
    """Centre and sigma of a Gaussian of which only a part is seen.

    ``ratio`` is the part's variance over sigma squared, ``moved`` what fitting sigma moved the
    centre by.
    """

    centre: float
    sigma: float
    ratio: float
    moved: float


def likelihood_size(half: int) -> int:
    """Entries of the likelihood's table for windows of ``half`` (fixed point) and narrower."""
    return int(np.ceil(_REACH * half)) + FRACTION


@kernel
def _median_row(column, counts):
    """Middle row, or the mean of the two middle rows; ``counts`` is zeroed scratch of 1024."""
    n = column.events
    low = np.int64(ROW_LAST)
    high = np.int64(0)
    for i in range(column.start, column.start + n):
        row = np.int64(column.packed[i] & ROW_MASK)
        counts[row] += 1
        low = min(low, row)
        high = max(high, row)
    seen = np.int64(0)
    lower = np.int64(-1)
    upper = np.int64(-1)
    for middle in range(low, high + 1):
        row = np.int64(middle)
        seen += counts[row]
        counts[row] = 0
        if lower < 0 and 2 * seen >= n:
            lower = np.int64(row)
        if upper < 0 and 2 * seen > n:
            upper = np.int64(row)
    return (lower + upper) / 2.0


@kernel
def _quantile_edge(counts, low, high, step, total):
    """Row from which on ``total / _EDGE_PART`` events lie behind, going from low to high.

    A row is a pixel half a row to either side with its events spread evenly over it. Between two
    rows with events the quantile may lie anywhere; the middle is taken.
    """
    seen = np.int64(0)
    row = low
    while True:
        here = counts[row]
        if _EDGE_PART * (seen + here) >= total and here > 0:
            break
        seen += here
        row += step
    if _EDGE_PART * (seen + here) > total:
        return row + step * ((total / _EDGE_PART - seen) / here - 0.5)
    other = row + step
    while other != high and counts[other] == 0:
        other += step
    return (row + other) / 2.0


@kernel
def _edge_midpoint(column, low, high, counts):
    """Middle between the rows below and above which an eighth of the events of low..high lies."""
    total = np.int64(0)
    for i in range(column.start, column.start + column.events):
        row = np.int64(column.packed[i] & ROW_MASK)
        if low <= row <= high:
            counts[row] += 1
            total += 1
    below = _quantile_edge(counts, low, high, 1, total)
    above = _quantile_edge(counts, high, low, -1, total)
    counts[low : high + 1] = 0
    return (below + above) / 2.0


@kernel
def _fill_likelihood(table, half):
    """Return ``exp(d^2 / 2 sigma^2)`` for distances of 0, 1, 2... fixed-point steps from the line.

    ``sigma`` is what the window of ``half`` was made for; the result is a view of ``table``.
    """
    size = np.int64(np.ceil(_REACH * half)) + FRACTION
    scale = 0.5 * (HALF_PER_SIGMA / (FRACTION * half)) ** 2
    for d in range(size):
        table[d] = np.exp(scale * (d * d))
    return table[:size]


@kernel
def _gauss_ml(column, window, first, last, half, rows, table):
    """Row of greatest likelihood for a Gaussian of known width on uniform background.

    Expectation-maximisation of the row and the background's share from the window's mean on, over
    the events of first..last within reach. The weights are whole numbers and depend on distances
    in fixed point: the sums are exact.
    """
    packed = column.packed
    start, n = column.start, column.events
    centre = window.centre
    line = float(window.sums.events)
    per_row = np.sqrt(2.0 * np.pi) * half / (HALF_PER_SIGMA * rows)
    reach = np.int64(_REACH * half)
    low, high = _limits(centre, reach, first, last)
    shift = 0.0
    for _ in range(EM_ITERATIONS):
        centre += np.int64(np.rint(shift))
        odds = (n - line) / line * per_row
        weights = np.int64(0)
        moment = np.int64(0)
        for i in range(start, start + n):
            row = np.int64(packed[i] & ROW_MASK)
            if low <= row <= high:
                d = row * FRACTION - centre
                w = np.int64(_WEIGHT_ONE / (1.0 + odds * table[min(abs(d), table.size - 1)]))
                weights += w
                moment += w * d
        weights = max(weights, np.int64(1))
        line = max(weights / _WEIGHT_ONE, 1.0)
        shift = moment / weights
    return (centre + shift) / FRACTION


@kernel
def _mean(window):
    """Mean row of a window's events."""
    events = window.sums.events
    return (events * window.first + window.sums.d) / events


@kernel
def _variance(sums):
    """Sample variance; the numerator is an exact integer, so a constant column gives 0."""
    n = sums.events
    if n < 2:
        return 0.0
    return (n * sums.d2 - sums.d * sums.d) / (float(n) * (n - 1))


@kernel
def _uncut_step(mean, centre, sigma):
    """Newton's next centre, not behind 0, of a Gaussian whose part beyond 0 has this mean.

    Returns also the part's variance over sigma squared.
    """
    alpha = -centre / sigma
    hazard = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * alpha * alpha) / math.erfc(alpha / np.sqrt(2.0))
    ratio = 1.0 + alpha * hazard - hazard * hazard
    return max(centre + (mean - centre - sigma * hazard) / ratio, 0.0), ratio


@kernel
def _uncut(mean, variance, count, sigma_max):
    """Centre and sigma of a Gaussian whose ``count`` events beyond 0 have this mean and variance.

    Sigma is ``sigma_max`` unless the variance is below what that lets expect and at most a third of
    the line is cut away, beyond which the two are hard to tell apart; then both are fitted. The
    centre is not behind 0. A part that keeps 3 of its standard deviations from 0 is not cut.
    """
    if mean > 3.0 * np.sqrt(variance):
        return Uncut(mean, np.sqrt(variance), 1.0, 0.0)
    known = mean
    ratio = 1.0
    for _ in range(_CUT_ITERATIONS):
        known, ratio = _uncut_step(mean, known, sigma_max)
    least = 1.0 - np.sqrt(_SCATTER / count)
    if known <= 0.5 * sigma_max or variance >= least * ratio * sigma_max * sigma_max:
        return Uncut(known, sigma_max, ratio, 0.0)
    centre = known
    sigma = sigma_max
    for _ in range(_CUT_ITERATIONS):
        sigma = min(np.sqrt(variance / ratio), sigma_max)
        centre, ratio = _uncut_step(mean, centre, sigma)
    return Uncut(centre, sigma, ratio, centre - known)


@kernel
def _uncut_row(row, sigma2, variance, window, half, rows, noise):
    """Row and its variance where the edge of the sensor may cut the window.

    The line is taken to be centred on the sensor. Real lines are flatter than a Gaussian: what the
    correction adds counts by seven tenths as an error, and wholly at the end of that range, and
    half of what fitting the line's width changes does too. The more is cut off, the more the
    counts scatter as independent ones do.
    """
    count = window.sums.events
    reach = half / FRACTION
    mean = _mean(window)
    from_low = mean + 0.5
    from_high = rows - 0.5 - mean
    beyond = min(from_low, from_high)
    if beyond > reach or max(from_low, from_high) <= reach or variance == 0.0:
        return Row(row, sigma2, False)
    line = _uncut(beyond, variance, count, reach * FRACTION / HALF_PER_SIGMA)
    shift = beyond - line.centre
    share = 1.0 if line.centre == 0.0 else 0.5
    factor2 = max(noise.factor**2, _CUT_FACTOR2)
    scatter2 = factor2 + max(1.0 - factor2, 0.0) * (1.0 - line.ratio)
    wider2 = scatter2 * line.sigma**2 / (line.ratio * count) + noise.floor**2
    wider2 += share * shift**2 + 0.25 * line.moved**2
    row = row - shift if from_low < from_high else row + shift
    # Another estimate than the mean may start closer to the edge than the correction is long.
    return Row(min(max(row, -0.5), rows - 0.5), max(sigma2, wider2), True)


@kernel
def _whole_sigma2(row, variance, own, count, rows, noise):
    """Row estimated from a whole column and its variance."""
    sigma2 = _sigma2(variance, own, count, row, rows, noise)
    # Stray events make a column wide; they do not bring its line to the edge.
    line = min(variance, _STRAY_FREE * own)
    reach = 3.0 * np.sqrt(line)
    cut = row < reach or rows - 1.0 - row < reach
    return Row(row, sigma2 + _CUT_BIAS2 * line if cut else sigma2, cut)
