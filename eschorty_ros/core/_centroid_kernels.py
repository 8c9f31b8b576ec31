"""Compiled column estimators: the windows of a column's returns, then the row in each."""

from __future__ import annotations

import numpy as np
from numba import njit

from eschorty_ros.core._mode_kernels import (
    AMBIGUOUS,
    FOUND,
    TOO_FEW,
    _mode_search,
    _second_return,
    _side,
    _stands_out,
)
from eschorty_ros.core._row_kernels import (
    _edge_midpoint,
    _fill_likelihood,
    _gauss_ml,
    _median_row,
    _uncut_row,
    _variance,
    _whole_sigma2,
)
from eschorty_ros.core._sigma_kernels import _common2, _sigma2
from eschorty_ros.core._window_kernels import ROW_BITS, ROW_LAST, _pad, _whole_column

# The methods up to MEAN are a window's mean.
MODE_MEAN, MEAN, MEDIAN, GAUSS_ML, EDGE_MID = 0, 1, 2, 3, 4
STRONGEST, FIRST, LAST, ALL = 0, 1, 2, 3


@njit(cache=True, nogil=True, error_model="numpy")
def _search(packed, start, n, blocks, method, half, rows, events_min):
    """The status, the window to estimate from, and its equal rival when it is ``AMBIGUOUS``."""
    if method == MEAN or method == MEDIAN:
        a = _whole_column(packed, start, blocks)
        return (FOUND if a[0] >= events_min else TOO_FEW), a, a
    status, a, b = _mode_search(packed, start, n, blocks, half)
    count = a[0] + b[0] if status == AMBIGUOUS else a[0]
    if a[0] < events_min or not _stands_out(count, n, half, rows):
        status = TOO_FEW
    return status, a, b


@njit(cache=True, nogil=True, error_model="numpy")
def _all_returns(packed, start, n, blocks, half, rows, events_min, status, a, b):
    """The status, the number of returns, the strongest and the other.

    Two equally strong ones are undecided only where the strongest is asked for.
    """
    if status == TOO_FEW:
        return status, 1, a, b
    if status == AMBIGUOUS:
        return FOUND, 2, a, b
    second, a, b = _second_return(packed, start, n, blocks, half, rows, events_min, a)
    return FOUND, 2 if second else 1, a, b


@njit(cache=True, nogil=True, error_model="numpy")
def _window_mean(window):
    """Mean row of a window's events and their variance."""
    count = window[0]
    return (count * window[1] + window[3]) / count, _variance(count, window[3], window[4])


@njit(cache=True, nogil=True, error_model="numpy")
def _row(packed, start, n, window, other, method, half, rows, counts, table, size):
    """Row of a return by the methods that look at the events again.

    ``other`` is the column's second return, or ``window`` itself when there is none.
    """
    if method == MEDIAN:
        return _median_row(packed, start, n, counts)
    if method == EDGE_MID:
        return _edge_midpoint(packed, start, n, window[1], window[2], counts)
    first, last = np.int64(0), np.int64(ROW_LAST)
    if other[6] != window[6]:
        first, last = _side(window[6], other[6])
    return _gauss_ml(packed, start, n, window, first, last, half, rows, table, size)


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(row, variance, own, window, method, half, rows, noise):
    """Row, its own variance and whether the edge of the sensor cuts its window."""
    if method == MEAN or method == MEDIAN:
        sigma2, cut = _whole_sigma2(row, variance, own, window[0], rows, noise)
        return row, sigma2, cut
    sigma2 = _sigma2(variance, own, window[0], row, rows, noise)
    if window[1] == 0 or window[2] >= rows - 1.0:
        return _uncut_row(row, sigma2, variance, window, half, rows, noise)
    return row, sigma2, False


@njit(cache=True, nogil=True, error_model="numpy")
def _chosen(returns, count, a, b):
    """Windows to report, nearest (least row) first, and how many."""
    if count == 1 or returns == STRONGEST:
        return 1, a, a
    near, far = (a, b) if a[6] < b[6] else (b, a)
    if returns == FIRST:
        return 1, near, far
    if returns == LAST:
        return 1, far, near
    return 2, near, far


@njit(cache=True, nogil=True, error_model="numpy")
def _estimate_lists(
    packed, offsets, method, returns, half, own, rows, events_min, noise, scratch, table,
    out_row, out_sigma, out_variance, out_events, out_cut, out_status,
):  # fmt: skip
    """Every column of a CSR layout on its own, without seeds."""
    counts = np.zeros(1 << ROW_BITS, np.int64)
    size = _fill_likelihood(table, half)
    out_row[:] = np.nan
    out_sigma[:] = np.nan
    out_variance[:] = np.nan
    out_events[:] = 0
    out_cut[:] = False
    out_status[:] = TOO_FEW
    for column in range(offsets.size - 1):
        n = offsets[column + 1] - offsets[column]
        if n < events_min or n == 0:
            continue
        scratch[:n] = packed[offsets[column] : offsets[column + 1]]
        blocks = _pad(scratch, 0, n)
        status, a, b = _search(scratch, 0, n, blocks, method, half, rows, events_min)
        found = 1
        if returns != STRONGEST:
            status, found, a, b = _all_returns(
                scratch, 0, n, blocks, half, rows, events_min, status, a, b
            )
        out_status[column] = status
        if status != FOUND:
            continue
        found, window, other = _chosen(returns, found, a, b)
        for k in range(found):
            row, variance = _window_mean(window)
            if method > MEAN:
                row = _row(scratch, 0, n, window, other, method, half, rows, counts, table, size)
            row, sigma2, cut = _judge(row, variance, own, window, method, half, rows, noise)
            out_row[column, k] = row
            out_sigma[column, k] = np.sqrt(sigma2 + _common2(window[6], -1, noise))
            out_variance[column, k] = variance
            out_events[column, k] = window[0]
            out_cut[column, k] = cut
            window, other = other, window
