"""Compiled smoothing over columns and rejection of lone points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel

ISOLATION_REACH = 2


class Smoothing(NamedTuple):
    """Settings of a profile's smoothing and of its lone points, and what the smoothing gives.

    Arrays have shape (returns, columns).
    """

    half_width: int
    gate_px: float
    isolation_gate_px: float
    isolation_events: int
    isolated: NDArray[np.bool_]
    row: NDArray[np.float64]
    sigma2: NDArray[np.float64]


@kernel
def _nearest(row, c, target):
    """Plane of column ``c`` whose row is nearest to ``target``; the first when none is."""
    best = 0
    for k in range(1, row.shape[0]):
        if abs(row[k, c] - target) < abs(row[best, c] - target) or np.isnan(row[best, c]):
            best = k
    return best


@kernel
def _partner(row, k, c, other):
    """Offset and plane of the return of column ``other`` that shows the surface of ``k`` of ``c``.

    Each of the two is the nearest to the other among its column's returns; NaN when they are not.
    """
    plane = _nearest(row, other, row[k, c])
    if _nearest(row, c, row[plane, other]) != k:
        return np.nan, plane
    return row[plane, other] - row[k, c], plane


@kernel
def _smooth(row, sigma2, common2, smoothing):
    """Mean over symmetric pairs of columns; returns how many points were averaged.

    ``sigma2`` is the columns' own variance, which the mean lessens, ``common2`` what they share.
    Arrays have one plane per return and one entry per column. The pairs grow outwards and end at
    the first one that is incomplete or beyond the gate.
    """
    half_width, gate = smoothing.half_width, smoothing.gate_px
    out_row, out_sigma2 = smoothing.row, smoothing.sigma2
    planes, columns = row.shape
    smoothed = 0
    for k in range(planes):
        for c in range(columns):
            out_row[k, c] = row[k, c]
            out_sigma2[k, c] = sigma2[k, c] + common2[k, c]
            centre = row[k, c]
            if np.isnan(centre):
                continue
            total = 0.0
            variance = sigma2[k, c]
            used = 1
            for j in range(1, half_width + 1):
                if c < j or c + j >= columns:
                    break
                before, after = 0, 0
                left = row[0, c - j] - centre
                right = row[0, c + j] - centre
                if planes > 1:
                    left, before = _partner(row, k, c, c - j)
                    right, after = _partner(row, k, c, c + j)
                if not (abs(left) <= gate and abs(right) <= gate):
                    break
                total += left + right
                variance += sigma2[before, c - j] + sigma2[after, c + j]
                used += 2
            if used > 1:
                out_row[k, c] = centre + total / used
                out_sigma2[k, c] = common2[k, c] + variance / (used * used)
                smoothed += 1
    return smoothed


@kernel
def _is_isolated(row, k, c, gate):
    planes, columns = row.shape
    for other in range(max(c - ISOLATION_REACH, 0), min(c + ISOLATION_REACH + 1, columns)):
        for plane in range(planes):
            if other != c and abs(row[plane, other] - row[k, c]) <= gate:
                return False
    return True


@kernel
def _reject_isolated(row, events, smoothing):
    """Make weak points without a neighbour near in rows NaN; returns their number."""
    isolated = smoothing.isolated
    planes, columns = row.shape
    count = 0
    for k in range(planes):
        for c in range(columns):
            isolated[k, c] = (
                not np.isnan(row[k, c])
                and events[k, c] < smoothing.isolation_events
                and _is_isolated(row, k, c, smoothing.isolation_gate_px)
            )
            count += isolated[k, c]
    if count > 0:
        for k in range(planes):
            for c in range(columns):
                if isolated[k, c]:
                    row[k, c] = np.nan
    return count
