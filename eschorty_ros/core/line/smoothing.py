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
    """Settings of smoothing and isolation, and the smoothed rows with their variance and width."""

    half_width: int
    gate_px: float
    isolation_gate_px: float
    isolation_events: int
    isolated: NDArray[np.bool_]
    row: NDArray[np.float64]
    sigma2: NDArray[np.float64]
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
def _smooth(rows, smoothing):
    """Average each point with symmetric pairs of neighbours; return the number of averaged points.

    The pairs are added outwards up to the first one that is incomplete or beyond the gate: a slope
    is preserved, no average crosses a larger step, no empty column is filled. The columns' own
    variances ``sigma2`` are independent, so that of the mean of n is their sum over n squared. The
    variance ``common2`` is shared by neighbours, whose lines cross the pixel rows at the same
    place, and is not reduced.
    """
    half_width, gate = smoothing.half_width, smoothing.gate_px
    out_row, out_sigma2, widths = smoothing.row, smoothing.sigma2, smoothing.widths
    row, sigma2, common2, spread2 = rows.row, rows.sigma2, rows.common2, rows.variance
    returns, columns = row.shape
    smoothed = 0
    for k in range(returns):
        for c in range(columns):
            out_row[k, c] = row[k, c]
            out_sigma2[k, c] = sigma2[k, c] + common2[k, c]
            centre = row[k, c]
            if np.isnan(centre):
                widths.smoothed[k, c] = np.nan
                continue
            total = 0.0
            variance = sigma2[k, c]
            width2 = spread2[k, c]
            used = 1
            for j in range(1, half_width + 1):
                if c < j or c + j >= columns:
                    break
                before, after = 0, 0
                left = row[0, c - j] - centre
                right = row[0, c + j] - centre
                if returns > 1:
                    left, before = _partner(row, k, c, c - j)
                    right, after = _partner(row, k, c, c + j)
                if not (abs(left) <= gate and abs(right) <= gate):
                    break
                total += left + right
                variance += sigma2[before, c - j] + sigma2[after, c + j]
                width2 += spread2[before, c - j] + spread2[after, c + j]
                used += 2
            widths.smoothed[k, c] = np.sqrt(width2 / used)
            widths.used[k, c] = used
            if used > 1:
                out_row[k, c] = centre + total / used
                out_sigma2[k, c] = common2[k, c] + variance / (used * used)
                smoothed += 1
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
