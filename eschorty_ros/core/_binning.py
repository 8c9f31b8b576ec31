"""Compiled pass that sorts events into columns and turns finished periods into points."""

from __future__ import annotations

import numpy as np
from numba import njit

from eschorty_ros.core._centroid_kernels import (
    AMBIGUOUS,
    BLOCK,
    FOUND,
    FRACTION,
    MODE_MEAN,
    ROW_BITS,
    TIME_LIMIT_US,
    _estimate_column,
    _mean_shift,
    _pad,
    _sigma2,
    _variance,
)
from eschorty_ros.core._phase_gate_kernels import G_LENGTH, _outside
from eschorty_ros.core._smoothing_kernels import _reject_isolated, _smooth

# state, int64
S_INDEX, S_EDGE, S_OPEN, S_HALF, S_POINTS, S_SIZE = 0, 1, 2, 3, 4, 5
# counters, int64
COUNTERS = (
    "events_binned",
    "events_before_first_edge",
    "events_outside_sensor",
    "events_over_column_limit",
    "events_gated",
    "periods_closed",
    "periods_empty",
    "columns_too_few_events",
    "columns_ambiguous",
    "columns_isolated",
    "columns_smoothed",
)
(
    C_BINNED, C_EARLY, C_OUTSIDE, C_OVER, C_GATED, C_CLOSED, C_EMPTY, C_FEW, C_AMBIGUOUS,
    C_ISOLATED, C_SMOOTHED,
) = range(len(COUNTERS))  # fmt: skip
# whole-number settings
P_METHOD, P_EVENTS_MIN, P_HALF_MAX, P_ROWS, P_SMOOTH, P_WEAK, P_SIZE = 0, 1, 2, 3, 4, 5, 6
# fractional settings
F_FACTOR, F_FLOOR, F_GATE, F_ISOLATION, F_SIZE = 0, 1, 2, 3, 4

ISOLATION_REACH = 2
_HALF_MIN = 3 * FRACTION
# 1.3 x FWHM for a Gaussian of unit standard deviation, fixed point
_HALF_PER_SIGMA = 1.3 * 2.3548200450309493 * FRACTION
_WIDTH_MIN_DOF = 64


@njit(cache=True, nogil=True, error_model="numpy")
def _append(t, x, y, p, first, stop, limit, lists, counts, rows, edge, gate, counters):
    """Append events before time ``limit`` that the gate lets through; returns the first left."""
    columns = np.uintp(counts.size)
    stride = np.uintp(lists.size) // columns
    room = np.uint32(stride - np.uintp(BLOCK))
    i = np.uintp(first)
    end = np.uintp(stop)
    over = 0
    outside = 0
    gated = 0
    gating = gate[G_LENGTH] > 0.0
    while i < end and t[i] < limit:
        c = np.uintp(x[i])
        r = np.uint32(y[i])
        dt = t[i] - edge
        if c < columns and r < rows:
            n = counts[c]
            if gating and _outside(dt, p[i], gate):
                gated += 1
            elif n < room:
                lists[c * stride + np.uintp(n)] = np.uint32(
                    (np.uint32(min(dt, TIME_LIMIT_US - 1)) << np.uint32(ROW_BITS)) | r
                )
                counts[c] = n + np.uint32(1)
            else:
                over += 1
        else:
            outside += 1
        i += np.uintp(1)
    counters[C_BINNED] += np.int64(i) - first - over - outside - gated
    counters[C_OVER] += over
    counters[C_OUTSIDE] += outside
    counters[C_GATED] += gated
    return np.int64(i)


@njit(cache=True, nogil=True, error_model="numpy")
def _estimate_period(
    lists, counts, seeds, whole, fractional, half, work, work_int, scratch, counters
):
    """Every column's row; returns the pooled sum of squares and degrees of freedom."""
    row, sigma2, variances = work[0], work[1], work[4]
    events, mean_dt = work_int[0], work_int[1]
    rows = float(whole[P_ROWS])
    squares = 0.0
    freedom = np.int64(0)
    neighbour = np.int64(-1)
    stride = lists.size // counts.size
    method, events_min = whole[P_METHOD], whole[P_EVENTS_MIN]
    factor, floor = fractional[F_FACTOR], fractional[F_FLOOR]
    for c in range(counts.size):
        n = np.int64(counts[c])
        counts[c] = 0
        row[c] = np.nan
        if n < events_min:
            if n > 0:
                counters[C_FEW] += 1
            continue
        start = c * stride
        seed = seeds[c] if seeds[c] >= 0 else neighbour
        used = np.int64(0)
        if method == MODE_MEAN and seed >= 0:
            used, low, sum_d, sum_d2, sum_time, centre = _mean_shift(
                lists, start, _pad(lists, start, n), seed, half
            )
        if used >= events_min and 2 * used > n:
            # No window elsewhere can hold more: the seed was right.
            r = (used * low + sum_d) / used
            variance = _variance(used, sum_d, sum_d2)
        else:
            status, r, used, variance, sum_time, centre = _estimate_column(
                lists, start, n, method, half, rows, events_min, scratch
            )
            if status != FOUND:
                counters[C_AMBIGUOUS if status == AMBIGUOUS else C_FEW] += 1
                continue
        row[c] = r
        sigma2[c] = _sigma2(variance, used, r, rows, factor, floor)
        variances[c] = variance
        events[c] = used
        mean_dt[c] = np.int64(np.rint(sum_time / used))
        seeds[c] = centre
        neighbour = centre
        squares += variance * (used - 1)
        freedom += used - 1
    return squares, freedom


@njit(cache=True, nogil=True, error_model="numpy")
def _adapted_half(half, squares, freedom, half_max):
    """Window for the next period: 1.3 x the width that this period's rows show, averaged."""
    if freedom < _WIDTH_MIN_DOF:
        return half
    wanted = _HALF_PER_SIGMA * np.sqrt(squares / freedom)
    return np.int64(min(max(np.rint(0.5 * (half + wanted)), _HALF_MIN), half_max))


@njit(cache=True, nogil=True, error_model="numpy")
def _close(lists, counts, seeds, state, whole, fractional, work, work_int, scratch, counters, out):
    """Turn the open period into points behind ``state[S_POINTS]``."""
    counters[C_CLOSED] += 1
    squares, freedom = _estimate_period(
        lists, counts, seeds, whole, fractional, state[S_HALF], work, work_int, scratch, counters
    )
    if whole[P_METHOD] == MODE_MEAN:
        state[S_HALF] = _adapted_half(state[S_HALF], squares, freedom, whole[P_HALF_MAX])
    row, sigma2, smooth_row, smooth_sigma2 = work[0], work[1], work[2], work[3]
    variances = work[4]
    events, mean_dt, rejected = work_int[0], work_int[1], work_int[2]
    isolated = _reject_isolated(
        row, events, ISOLATION_REACH, fractional[F_ISOLATION], whole[P_WEAK], rejected
    )
    if isolated > 0:
        counters[C_ISOLATED] += isolated
        for c in range(row.size):
            if rejected[c]:
                row[c] = np.nan
    counters[C_SMOOTHED] += _smooth(
        row, sigma2, fractional[F_FLOOR] ** 2, whole[P_SMOOTH], fractional[F_GATE], smooth_row,
        smooth_sigma2,
    )  # fmt: skip
    (
        out_period, out_edge, out_t, out_column, out_row, out_sigma, out_width, out_events,
        out_return,
    ) = out  # fmt: skip
    k = state[S_POINTS]
    for c in range(row.size):
        if np.isnan(row[c]):
            continue
        out_period[k] = state[S_INDEX]
        out_edge[k] = state[S_EDGE]
        out_t[k] = state[S_EDGE] + mean_dt[c]
        out_column[k] = c
        out_row[k] = smooth_row[c]
        out_sigma[k] = np.sqrt(smooth_sigma2[c])
        out_width[k] = np.sqrt(variances[c])
        out_events[k] = events[c]
        out_return[k] = 0
        k += 1
    state[S_POINTS] = k


@njit(cache=True, nogil=True, error_model="numpy")
def _bin(
    t, x, y, p, first, stop, edges, indices, edge, edge_count, drain, gate, lists, counts, seeds,
    state, whole, fractional, work, work_int, scratch, counters, out,
):  # fmt: skip
    """Merge events ``first..stop`` with edges ``edge..edge_count``.

    A period is closed when an event reaches its end or, with ``drain``, when the events are
    through. Returns the first event and the first edge not dealt with; fewer than all when the
    output has no room for another profile.
    """
    columns = counts.size
    room = out[0].size
    i = first
    far = np.int64(1 << 62)
    while True:
        limit = edges[edge] if edge < edge_count else far
        if i < stop and t[i] < limit:
            if state[S_OPEN] == 0:
                begin = i
                while i < stop and t[i] < limit:
                    i += 1
                counters[C_EARLY] += i - begin
            else:
                i = _append(
                    t, x, y, p, i, stop, limit, lists, counts, np.uint32(whole[P_ROWS]),
                    state[S_EDGE], gate, counters,
                )  # fmt: skip
                state[S_OPEN] = 2
        if edge == edge_count or (i == stop and not drain):
            return i, edge
        if state[S_OPEN] == 2:
            if state[S_POINTS] + columns > room:
                return i, edge
            _close(
                lists, counts, seeds, state, whole, fractional, work, work_int, scratch, counters,
                out,
            )  # fmt: skip
        elif state[S_OPEN] == 1:
            counters[C_EMPTY] += 1
        state[S_OPEN] = 1
        state[S_EDGE] = edges[edge]
        state[S_INDEX] = indices[edge]
        edge += 1
