"""Smoothing of a profile over its columns, and rejection of isolated points.

Arrays have shape (returns, columns) and hold NaN where there is no return.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.unusual import Widths

# Columns to either side in which a weak point needs a neighbour.
_ISOLATION_REACH = 2


class Smoothing(NamedTuple):
    """Settings of smoothing and isolation, and the smoothed rows with their variance and width.

    ``gates_px`` are the gates of a profile's points: ``gate_px``, or more where rows scatter more.
    """

    half_width: int
    gate_px: float
    isolation_gate_px: float
    isolation_events: int
    isolated: NDArray[np.bool_]
    row: NDArray[np.float64]
    sigma2: NDArray[np.float64]
    gates_px: NDArray[np.float64]
    widths: Widths


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
def _add_pairs(rows, k, j, gates, sums):
    """Add the neighbours ``j`` columns away to those points of return ``k`` that have all nearer.

    ``sums`` are those of the rows' differences, the variances, the spreads and the points.
    """
    row, columns = rows.row, np.uintp(rows.row.shape[1])
    difference, variance, spread2, used = sums
    for c in range(np.uintp(j), columns - np.uintp(j)):
        if used[k, c] == 2 * j - 1 and not np.isnan(row[k, c]):
            left, before = _partner(row, k, c, c - np.uintp(j))
            right, after = _partner(row, k, c, c + np.uintp(j))
            if abs(left) <= gates[k, c] and abs(right) <= gates[k, c]:
                difference[k, c] += left + right
                variance[k, c] += rows.sigma2[before, c - j] + rows.sigma2[after, c + j]
                spread2[k, c] += rows.variance[before, c - j] + rows.variance[after, c + j]
                used[k, c] += 2.0


@kernel(_nrt=False)
def _add_values(values, total, used, j):
    """Add the values ``j`` columns away to the totals of the points that use these neighbours."""
    j, columns = np.uintp(j), np.uintp(total.shape[1])
    number = 2.0 * j + 1.0
    for c in range(j, columns - j):
        pair = values[0, c - j] + values[0, c + j]
        total[0, c] += pair if used[0, c] == number else 0.0


@kernel(_nrt=False)
def _add_only_pairs(rows, j, gates, sums):
    """Add the neighbours as `_add_pairs` does, where a column has one return: in vectors."""
    row = rows.row
    difference, variance, spread2, used = sums
    number = 2.0 * j - 1.0
    j, columns = np.uintp(j), np.uintp(row.shape[1])
    for c in range(j, columns - j):
        left, right = row[0, c - j] - row[0, c], row[0, c + j] - row[0, c]
        gate = gates[0, c]
        near = (used[0, c] == number) & (abs(left) <= gate) & (abs(right) <= gate)
        difference[0, c] += left + right if near else 0.0
        used[0, c] += 2.0 if near else 0.0
    _add_values(rows.sigma2, variance, used, j)
    _add_values(rows.variance, spread2, used, j)


@kernel(_nrt=False)
def _smooth(rows, smoothing):
    """Average each point with symmetric pairs of neighbours; return the number of averaged points.

    The pairs are added outwards up to the first one that is incomplete or beyond the gate: a slope
    is preserved, no average crosses a larger step, no empty column is filled. The columns' own
    variances ``sigma2`` are independent, so that of the mean of n is their sum over n squared. The
    variance ``common2``, which neighbours share, is not reduced and not included yet.
    """
    out_row, out_sigma2 = smoothing.row, smoothing.sigma2
    out_width, used = smoothing.widths.smoothed, smoothing.widths.used
    returns, columns = rows.row.shape
    for k in range(returns):
        for c in range(columns):
            out_row[k, c] = 0.0
            out_sigma2[k, c] = rows.sigma2[k, c]
        for c in range(columns):
            out_width[k, c] = rows.variance[k, c]
            used[k, c] = 1.0
    sums = out_row, out_sigma2, out_width, used
    for j in range(1, min(smoothing.half_width, (columns - 1) // 2) + 1):
        if returns == 1:
            _add_only_pairs(rows, j, smoothing.gates_px, sums)
        else:
            for k in range(returns):
                _add_pairs(rows, k, j, smoothing.gates_px, sums)
    smoothed = 0
    for k in range(returns):
        for c in range(columns):
            n = used[k, c]
            out_row[k, c] = rows.row[k, c] + out_row[k, c] / n
            smoothed += n > 1.0
        for c in range(columns):
            n = used[k, c]
            out_sigma2[k, c] /= n * n
        for c in range(columns):
            width = np.sqrt(out_width[k, c] / used[k, c])
            out_width[k, c] = np.nan if np.isnan(rows.row[k, c]) else width
    return smoothed


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
    """Set weak and doubtful points without a neighbour near in rows to NaN; return their number."""
    row, isolated = rows.row, smoothing.isolated
    returns, columns = row.shape
    count = 0
    for k in range(returns):
        for c in range(columns):
            isolated[k, c] = (
                not np.isnan(row[k, c])
                and smoothing.isolation_events > 0
                and (rows.doubtful[k, c] or rows.events[k, c] < smoothing.isolation_events)
                and _is_isolated(row, k, c, smoothing.isolation_gate_px)
            )
            count += isolated[k, c]
    if count > 0:
        for k in range(returns):
            for c in range(columns):
                if isolated[k, c]:
                    row[k, c] = np.nan
    return count
