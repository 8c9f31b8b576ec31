"""Smoothing of a profile over its columns, and rejection of isolated points.

Arrays have shape (returns, columns) and hold NaN where there is no return.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS

# Columns to either side in which a weak point needs a neighbour.
_ISOLATION_REACH = 2
# Blocks of columns on either side that choose the half width of a block together.
_NEAR = 2
# Share of a profile's errors that the next keeps.
_KEPT = 0.5
# Neighbours on either side that a width is averaged with.
WIDTH_PAIRS = 2
# Columns of such a mean.
WIDTH_COLUMNS = 2.0 * WIDTH_PAIRS + 1.0


class Averages(NamedTuple):
    """Sums over each point and its neighbours by half width, shape (half widths, returns, columns).

    They are those of the neighbours' differences from the point's row and of the points ``used``.
    ``squares`` are a profile's squared errors of prediction, ``sigma2_before`` and
    ``variance_before`` the sums of variances and of spreads over the columns before each.
    """

    difference: NDArray[np.float64]
    used: NDArray[np.float64]
    squares: NDArray[np.float64]
    sigma2_before: NDArray[np.float64]
    variance_before: NDArray[np.float64]


class Smoothing(NamedTuple):
    """Settings of smoothing and isolation, and the smoothed rows with their variance and width.

    ``half_widths`` are those to choose from, and ``errors`` the squared errors of what neighbours
    predict, by half width and block of columns. A row is the mean of the columns ``used``.
    ``gates_px`` are the gates of a profile's points: ``gate_px``, or more where rows scatter more.
    """

    half_widths: NDArray[np.int64]
    errors: NDArray[np.float64]
    averages: Averages
    gate_px: float
    isolation_gate_px: float
    isolation_events: int
    isolated: NDArray[np.bool_]
    row: NDArray[np.float64]
    sigma2: NDArray[np.float64]
    used: NDArray[np.float64]
    gates_px: NDArray[np.float64]
    width: NDArray[np.float64]


def half_widths(largest: int) -> NDArray[np.int64]:
    """Return the half widths to choose from: powers of two up to the largest, and that one."""
    powers = 1 << np.arange(largest.bit_length())
    return np.unique(np.append(powers[powers < largest], largest))


def empty_smoothing(
    largest: int,
    gate_px: float,
    isolation_gate_px: float,
    isolation_events: int,
    shape: tuple[int, int],
) -> Smoothing:
    """Return the smoothing of profiles of a ``shape``, by half widths up to the ``largest``."""
    tried, columns = half_widths(largest), shape[1]
    blocks = -(-columns // BLOCK_COLUMNS)
    differences, averaged = np.zeros((2, tried.size, *shape))
    sigma2_before, variance_before = np.zeros((2, columns + 1))
    row, sigma2, used, gates_px = np.zeros((4, *shape))
    return Smoothing(
        half_widths=tried,
        errors=np.zeros((tried.size, blocks + 2 * _NEAR)),
        averages=Averages(differences, averaged, np.zeros(columns), sigma2_before, variance_before),
        gate_px=gate_px,
        isolation_gate_px=isolation_gate_px,
        isolation_events=isolation_events,
        isolated=np.zeros(shape, np.bool_),
        row=row,
        sigma2=sigma2,
        used=used,
        gates_px=gates_px,
        width=np.full(shape, np.nan),
    )


@kernel(_nrt=False)
def _nearest(row, c, target):
    """Return the index of column ``c``'s return nearest to the row ``target``; 0 if it has none."""
    best = 0
    for k in range(1, row.shape[0]):
        if abs(row[k, c] - target) < abs(row[best, c] - target) or np.isnan(row[best, c]):
            best = k
    return best


@kernel(_nrt=False)
def _partner(row, k, c, other):
    """Return the offset and index of the return in column ``other`` that continues ``k`` of ``c``.

    Two returns continue each other when each is the nearest to the other in its column; the offset
    is NaN otherwise.
    """
    index = _nearest(row, other, row[k, c])
    if _nearest(row, c, row[index, other]) != k:
        return np.nan, index
    return row[index, other] - row[k, c], index


@kernel(_nrt=False)
def _add_pairs(row, gates, k, j, level, averages):
    """Add neighbours ``j`` columns away to those points of return ``k`` that have all nearer."""
    difference, used = averages.difference, averages.used
    j, columns = np.uintp(j), np.uintp(row.shape[1])
    for c in range(j, columns - j):
        if used[level, k, c] == 2 * j - 1 and not np.isnan(row[k, c]):
            left = _partner(row, k, c, c - j)[0]
            right = _partner(row, k, c, c + j)[0]
            if abs(left) <= gates[k, c] and abs(right) <= gates[k, c]:
                difference[level, k, c] += left + right
                used[level, k, c] += 2.0


@kernel(_nrt=False)
def _add_only_pairs(row, gates, j, level, averages):
    """Add the neighbours as `_add_pairs` does, where a column has one return: in vectors."""
    difference, used = averages.difference, averages.used
    number = 2.0 * j - 1.0
    j, columns = np.uintp(j), np.uintp(row.shape[1])
    for c in range(j, columns - j):
        left, right = row[0, c - j] - row[0, c], row[0, c + j] - row[0, c]
        gate = gates[0, c]
        near = (used[level, 0, c] == number) & (abs(left) <= gate) & (abs(right) <= gate)
        difference[level, 0, c] += left + right if near else 0.0
        used[level, 0, c] += 2.0 if near else 0.0


@kernel(_nrt=False)
def _add_errors(averages, level, errors):
    """Add the squared errors with which the neighbours of each point predict it, by block."""
    difference, used, squares = averages.difference, averages.used, averages.squares
    _, returns, columns = used.shape
    for i in range(errors.shape[1]):
        errors[level, i] *= _KEPT
    for k in range(returns):
        for c in range(columns):
            error = difference[level, k, c] / max(used[level, k, c] - 1.0, 1.0)
            squares[c] = error * error
        for block in range(errors.shape[1] - 2 * _NEAR):
            total = 0.0
            end = min((block + 1) * BLOCK_COLUMNS, columns)
            for c in range(np.uintp(block * BLOCK_COLUMNS), np.uintp(end)):
                total += squares[c]
            errors[level, block + _NEAR] += total


@kernel(_nrt=False)
def _sum_before(rows, averages):
    """Fill the sums of the variances and of the spreads of all columns before each."""
    sigma2, variance = 0.0, 0.0
    for c in range(np.uintp(rows.row.shape[1])):
        found = not np.isnan(rows.row[0, c])
        sigma2 += rows.sigma2[0, c] if found else 0.0
        variance += rows.variance[0, c] if found else 0.0
        averages.sigma2_before[c + np.uintp(1)] = sigma2
        averages.variance_before[c + np.uintp(1)] = variance


@kernel(_nrt=False, forceinline=True)
def _sums_of(rows, k, c, pairs, averages):
    """Return the sum of the variances of a point and its pairs of neighbours.

    The second value is that of the spreads of the nearest of them.
    """
    near = min(pairs, np.uintp(WIDTH_PAIRS))
    if rows.row.shape[0] == 1:
        end, near_end = c + pairs + np.uintp(1), c + near + np.uintp(1)
        sigma2, variance = averages.sigma2_before, averages.variance_before
        return sigma2[end] - sigma2[c - pairs], variance[near_end] - variance[c - near]
    sigma2, variance = rows.sigma2[k, c], rows.variance[k, c]
    for j in range(np.uintp(1), pairs + np.uintp(1)):
        for other in (c - j, c + j):
            partner = _partner(rows.row, k, c, other)[1]
            sigma2 += rows.sigma2[partner, other]
            variance += rows.variance[partner, other] if j <= near else 0.0
    return sigma2, variance


@kernel(_nrt=False)
def _best(errors, block):
    """Return the half width, by its index, whose neighbours predict the rows near a block best."""
    best, least, first = 0, np.inf, np.uintp(block)
    for level in range(errors.shape[0]):
        error = 0.0
        for i in range(np.uintp(2 * _NEAR + 1)):
            error += errors[np.uintp(level), first + i]
        if error <= least:
            best, least = level, error
    return best


@kernel(_nrt=True)
def _begin_level(difference, used, level):
    """Begin with the neighbours of the next smaller half width, or without any."""
    if level > 0:
        difference[level], used[level] = difference[level - 1], used[level - 1]
    else:
        difference[0], used[0] = 0.0, 1.0


@kernel(_nrt=False)
def _divide(rows, smoothing):
    """Divide the sums of points and neighbours.

    Loops over all columns, each over a few arrays, run in vectors.
    """
    for k in range(rows.row.shape[0]):
        own, row, used = rows.row[k], smoothing.row[k], smoothing.used[k]
        sigma2, width = smoothing.sigma2[k], smoothing.width[k]
        for c in range(np.uintp(own.size)):
            row[c] = own[c] + row[c] / used[c]
        for c in range(np.uintp(own.size)):
            sigma2[c] /= used[c] * used[c]
        for c in range(np.uintp(own.size)):
            near = min(used[c], WIDTH_COLUMNS)
            width[c] = np.nan if np.isnan(own[c]) else np.sqrt(width[c] / near)


@kernel(_nrt=False)
def _smooth(rows, smoothing):
    """Average each point with symmetric pairs of neighbours.

    The pairs are added outwards up to the first one that is incomplete or beyond the gate: a slope
    is preserved, no average crosses a larger step, no empty column is filled. Of the half widths
    that one is taken whose neighbours predict the rows near by best (leave-one-out
    cross-validation). The columns' own variances ``sigma2`` are independent, so that of the mean of
    n is their sum over n squared. The variance ``common2``, which neighbours share, is not reduced
    and not included yet.
    """
    averages, errors = smoothing.averages, smoothing.errors
    difference, used = averages.difference, averages.used
    returns, columns = rows.row.shape
    added = 0
    for level in range(smoothing.half_widths.size):
        _begin_level(difference, used, level)
        half_width = smoothing.half_widths[level]
        for j in range(added + 1, min(half_width, (columns - 1) // 2) + 1):
            if returns == 1:
                _add_only_pairs(rows.row, smoothing.gates_px, j, level, averages)
            else:
                for k in range(returns):
                    _add_pairs(rows.row, smoothing.gates_px, k, j, level, averages)
        added = half_width
        _add_errors(averages, level, errors)
    _sum_before(rows, averages)
    for block in range(errors.shape[1] - 2 * _NEAR):
        level = _best(errors, block)
        first = np.uintp(block * BLOCK_COLUMNS)
        end = np.uintp(min((block + 1) * BLOCK_COLUMNS, columns))
        for k in range(np.uintp(returns)):
            for c in range(first, end):
                n = used[level, k, c]
                sums = _sums_of(rows, k, c, np.uintp(n) // np.uintp(2), averages)
                smoothing.sigma2[k, c], smoothing.width[k, c] = sums
                smoothing.row[k, c], smoothing.used[k, c] = difference[level, k, c], n
    _divide(rows, smoothing)


@kernel(_nrt=False)
def _is_isolated(row, k, c, gate):
    returns, columns = row.shape
    for other in range(max(c - _ISOLATION_REACH, 0), min(c + _ISOLATION_REACH + 1, columns)):
        for index in range(returns):
            if other != c and abs(row[index, other] - row[k, c]) <= gate:
                return False
    return True


@kernel(_nrt=False)
def _reject_isolated(rows, smoothing):
    """Set weak or uncertain points without a neighbour near in rows to NaN; return their number."""
    row, isolated = rows.row, smoothing.isolated
    returns, columns = row.shape
    count = 0
    for k in range(returns):
        for c in range(columns):
            isolated[k, c] = (
                not np.isnan(row[k, c])
                and smoothing.isolation_events > 0
                and (rows.uncertain[k, c] or rows.events[k, c] < smoothing.isolation_events)
                and _is_isolated(row, k, c, smoothing.isolation_gate_px)
            )
            count += isolated[k, c]
    if count > 0:
        for k in range(returns):
            for c in range(columns):
                if isolated[k, c]:
                    row[k, c] = np.nan
    return count
