"""Compiled smoothing over columns and rejection of lone points."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth(row, sigma2, common2, half_width, gate, out_row, out_sigma2):
    """Mean over symmetric pairs of columns; returns how many columns were averaged.

    The pairs grow outwards and end at the first one that is incomplete or beyond the gate.
    """
    columns = row.size
    smoothed = 0
    for c in range(columns):
        out_row[c] = row[c]
        out_sigma2[c] = sigma2[c]
        centre = row[c]
        if np.isnan(centre):
            continue
        total = 0.0
        variance = sigma2[c] - common2
        used = 1
        for j in range(1, half_width + 1):
            if c < j or c + j >= columns:
                break
            left = row[c - j] - centre
            right = row[c + j] - centre
            if not (abs(left) <= gate and abs(right) <= gate):
                break
            total += left + right
            variance += sigma2[c - j] + sigma2[c + j] - 2.0 * common2
            used += 2
        if used > 1:
            out_row[c] = centre + total / used
            out_sigma2[c] = common2 + variance / (used * used)
            smoothed += 1
    return smoothed


@njit(cache=True, nogil=True, error_model="numpy")
def _reject_isolated(row, events, reach, gate, events_weak, rejected):
    """Mark weak points without a neighbour near in rows; returns their number."""
    columns = row.size
    count = 0
    for c in range(columns):
        rejected[c] = False
        if np.isnan(row[c]) or events[c] >= events_weak:
            continue
        alone = True
        for k in range(max(c - reach, 0), min(c + reach + 1, columns)):
            if k != c and abs(row[k] - row[c]) <= gate:
                alone = False
                break
        if alone:
            rejected[c] = True
            count += 1
    return count
