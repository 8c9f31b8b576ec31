"""Smoothing of a profile over its columns, and rejection of points nothing speaks for."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from eschorty_ros.core.errors import ArgumentError


@njit(cache=True, nogil=True)
def _smooth(row, sigma2, half_width, gate, out_row, out_sigma2):
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
        variance = sigma2[c]
        used = 1
        for j in range(1, half_width + 1):
            if c < j or c + j >= columns:
                break
            left = row[c - j] - centre
            right = row[c + j] - centre
            if not (abs(left) <= gate and abs(right) <= gate):
                break
            total += left + right
            variance += sigma2[c - j] + sigma2[c + j]
            used += 2
        if used > 1:
            out_row[c] = centre + total / used
            out_sigma2[c] = variance / (used * used)
            smoothed += 1
    return smoothed


@njit(cache=True, nogil=True)
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


def smooth(
    row: NDArray[np.float64],
    sigma_row: NDArray[np.float64],
    half_width: int = 2,
    gate_px: float = 2.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average each column with symmetric pairs of neighbours.

    Parameters
    ----------
    row, sigma_row : ndarray of float64, shape (columns,)
        NaN where a column is not lit.
    half_width : int
        Pairs at most; 0 returns copies.
    gate_px : float
        Both columns of a pair must be lit and this close in rows to the centre; the first pair
        that is not ends the average.

    Returns
    -------
    row, sigma_row : ndarray of float64, shape (columns,)

    Notes
    -----
    Pairs leave a linear slope as it is. No average reaches across a step larger than the gate and
    no dark column is filled. The columns' errors are independent (different pixels), so the
    variance of the mean of n columns is the sum of theirs over n squared.

    Raises
    ------
    ArgumentError
        When shapes differ, or a parameter is negative.
    """
    rows = np.ascontiguousarray(row, dtype=np.float64)
    sigma = np.ascontiguousarray(sigma_row, dtype=np.float64)
    if rows.ndim != 1 or rows.shape != sigma.shape:
        raise ArgumentError(
            f"row has shape {rows.shape} and sigma_row {sigma.shape}; give two equal axes"
        )
    if half_width < 0 or not gate_px >= 0.0:
        raise ArgumentError(
            f"half_width is {half_width!r} and gate_px {gate_px!r}; choose 0 or more"
        )
    out_row, out_sigma2 = np.empty_like(rows), np.empty_like(rows)
    _smooth(rows, sigma * sigma, half_width, gate_px, out_row, out_sigma2)
    return out_row, np.sqrt(out_sigma2)
