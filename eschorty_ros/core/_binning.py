"""Compiled pass that sorts events into columns and turns finished periods into points."""

from __future__ import annotations

import numpy as np
from numba import njit

from eschorty_ros.core._centroid_kernels import (
    GAUSS_ML,
    MEAN,
    MEDIAN,
    STRONGEST,
    _all_returns,
    _chosen,
    _judge,
    _row,
    _search,
    _window_mean,
)
from eschorty_ros.core._mode_kernels import AMBIGUOUS, FOUND
from eschorty_ros.core._phase_gate_kernels import G_LENGTH, _outside
from eschorty_ros.core._row_kernels import HALF_PER_SIGMA, _fill_likelihood
from eschorty_ros.core._sigma_kernels import _clipped2, _common2
from eschorty_ros.core._smoothing_kernels import _reject_isolated, _smooth
from eschorty_ros.core._window_kernels import (
    BLOCK,
    FRACTION,
    ROW_BITS,
    ROW_LAST,
    TIME_LIMIT_US,
    _mean_shift,
    _pad,
)

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
    "columns_two_returns",
)
(
    C_BINNED, C_EARLY, C_OUTSIDE, C_OVER, C_GATED, C_CLOSED, C_EMPTY, C_FEW, C_AMBIGUOUS,
    C_ISOLATED, C_SMOOTHED, C_TWO,
) = range(len(COUNTERS))  # fmt: skip
# whole-number settings
P_METHOD, P_RETURNS, P_EVENTS_MIN, P_HALF_MAX, P_ROWS, P_SMOOTH, P_WEAK, P_SIZE = range(8)
# fractional settings
F_GATE, F_ISOLATION, F_OWN, F_SIZE = range(4)
# a column's numbers, one plane per return
(W_ROW, W_SIGMA2, W_COMMON2, W_SMOOTH_ROW, W_SMOOTH_SIGMA2, W_VARIANCE, W_SIZE) = range(7)
N_EVENTS, N_MEAN_DT, N_REJECTED, N_SIZE = range(4)

ISOLATION_REACH = 2
_HALF_MIN = 3 * FRACTION
_WIDTH_MIN_DOF = 64
# A whole column wider than this many times the line's variance holds stray events.
_STRAYED = 1.5
_NO_WINDOW = (np.int64(0),) * 7


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
    lists, counts, seeds, whole, fractional, noise, half, work, work_int, scratch, table, counters
):
    """Every column's rows; returns the pooled sum of squares and degrees of freedom."""
    row, sigma2, common2 = work[W_ROW], work[W_SIGMA2], work[W_COMMON2]
    variances = work[W_VARIANCE]
    events, mean_dt = work_int[N_EVENTS], work_int[N_MEAN_DT]
    row[:] = np.nan
    rows = float(whole[P_ROWS])
    squares = 0.0
    freedom = np.int64(0)
    neighbour = np.int64(-1)
    stride = lists.size // counts.size
    method, returns, events_min = whole[P_METHOD], whole[P_RETURNS], whole[P_EVENTS_MIN]
    windowed = method != MEAN and method != MEDIAN
    own = min((half / HALF_PER_SIGMA) ** 2, fractional[F_OWN])
    size = _fill_likelihood(table, half) if method == GAUSS_ML else np.int64(0)
    for c in range(counts.size):
        n = np.int64(counts[c])
        counts[c] = 0
        if n < events_min:
            if n > 0:
                counters[C_FEW] += 1
            continue
        start = c * stride
        blocks = _pad(lists, start, n)
        seed = seeds[c] if seeds[c] >= 0 else neighbour
        a = b = _NO_WINDOW
        if windowed and seed >= 0:
            a = b = _mean_shift(lists, start, blocks, seed, half, 0, ROW_LAST)
        status, found = FOUND, 1
        if a[0] < events_min or 2 * a[0] <= n:
            # A window elsewhere may hold more than the seed's.
            status, a, b = _search(lists, start, n, blocks, method, half, rows, events_min)
        if returns != STRONGEST:
            status, found, a, b = _all_returns(
                lists, start, n, blocks, half, rows, events_min, status, a, b
            )
        if status != FOUND:
            counters[C_AMBIGUOUS if status == AMBIGUOUS else C_FEW] += 1
            continue
        last = seeds[c]
        seeds[c] = neighbour = a[6]
        counters[C_TWO] += found - 1
        found, window, other = _chosen(returns, found, a, b)
        for k in range(found):
            r, variance = _window_mean(window)
            if method > MEAN:
                r = _row(lists, start, n, window, other, method, half, rows, scratch, table, size)
            row[k, c], sigma2[k, c], cut = _judge(
                r, variance, own, window, method, half, rows, noise
            )
            if not windowed:
                seeds[c] = np.int64(np.rint(FRACTION * r))
            common2[k, c] = _common2(seeds[c], last, noise)
            # Until a profile has shown the line's width, nothing can be said to be missing.
            if not cut and half < whole[P_HALF_MAX]:
                common2[k, c] += _clipped2(variance, own, noise)
            used = window[0]
            variances[k, c] = variance
            events[k, c] = used
            mean_dt[k, c] = np.int64(np.rint(window[5] / used))
            if not cut and (windowed or variance <= _STRAYED * fractional[F_OWN]):
                squares += variance * (used - 1)
                freedom += used - 1
            window, other = other, window
    return squares, freedom


@njit(cache=True, nogil=True, error_model="numpy")
def _adapted_half(half, squares, freedom, half_max):
    """Window for the next period: 1.3 x the width that this period's rows show, averaged."""
    if freedom < _WIDTH_MIN_DOF:
        return half
    wanted = HALF_PER_SIGMA * np.sqrt(squares / freedom)
    return np.int64(min(max(np.rint(0.5 * (half + wanted)), _HALF_MIN), half_max))


@njit(cache=True, nogil=True, error_model="numpy")
def _emit(work, work_int, state, out):
    """Write the period's points behind ``state[S_POINTS]``, by column, nearest return first."""
    (
        out_period, out_edge, out_t, out_column, out_row, out_sigma, out_width, out_events,
        out_return,
    ) = out  # fmt: skip
    planes, columns = work[W_ROW].shape
    i = state[S_POINTS]
    for c in range(columns):
        place = 0
        for k in range(planes):
            if np.isnan(work[W_ROW, k, c]):
                continue
            out_period[i] = state[S_INDEX]
            out_edge[i] = state[S_EDGE]
            out_t[i] = state[S_EDGE] + work_int[N_MEAN_DT, k, c]
            out_column[i] = c
            out_row[i] = work[W_SMOOTH_ROW, k, c]
            out_sigma[i] = np.sqrt(work[W_SMOOTH_SIGMA2, k, c])
            out_width[i] = np.sqrt(work[W_VARIANCE, k, c])
            out_events[i] = work_int[N_EVENTS, k, c]
            out_return[i] = place
            place += 1
            i += 1
    state[S_POINTS] = i


@njit(cache=True, nogil=True, error_model="numpy")
def _close(
    lists, counts, seeds, state, whole, fractional, noise, work, work_int, scratch, table, counters,
    out,
):  # fmt: skip
    """Turn the open period into points."""
    counters[C_CLOSED] += 1
    squares, freedom = _estimate_period(
        lists, counts, seeds, whole, fractional, noise, state[S_HALF], work, work_int, scratch,
        table, counters,
    )  # fmt: skip
    state[S_HALF] = _adapted_half(state[S_HALF], squares, freedom, whole[P_HALF_MAX])
    counters[C_ISOLATED] += _reject_isolated(
        work[W_ROW], work_int[N_EVENTS], ISOLATION_REACH, fractional[F_ISOLATION], whole[P_WEAK],
        work_int[N_REJECTED],
    )  # fmt: skip
    counters[C_SMOOTHED] += _smooth(
        work[W_ROW], work[W_SIGMA2], work[W_COMMON2], whole[P_SMOOTH],
        fractional[F_GATE], work[W_SMOOTH_ROW], work[W_SMOOTH_SIGMA2],
    )  # fmt: skip
    _emit(work, work_int, state, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _bin(
    t, x, y, p, first, stop, edges, indices, edge, edge_count, drain, gate, lists, counts, seeds,
    state, whole, fractional, noise, work, work_int, scratch, table, counters, out,
):  # fmt: skip
    """Merge events ``first..stop`` with edges ``edge..edge_count``.

    A period is closed when an event reaches its end or, with ``drain``, when the events are
    through. Returns the first event and the first edge not dealt with; fewer than all when the
    output has no room for another profile.
    """
    room = out[0].size - work[0].size
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
            if state[S_POINTS] > room:
                return i, edge
            _close(
                lists, counts, seeds, state, whole, fractional, noise, work, work_int, scratch,
                table, counters, out,
            )  # fmt: skip
        elif state[S_OPEN] == 1:
            counters[C_EMPTY] += 1
        state[S_OPEN] = 1
        state[S_EDGE] = edges[edge]
        state[S_INDEX] = indices[edge]
        edge += 1
