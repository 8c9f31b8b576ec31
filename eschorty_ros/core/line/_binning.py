"""Compiled pass that sorts events into columns and turns finished periods into points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line._centroid import (
    Columns,
    Estimator,
    Rows,
    Scratch,
    _estimate_columns,
)
from eschorty_ros.core.line._row import HALF_PER_SIGMA
from eschorty_ros.core.line._smoothing import Smoothing, _reject_isolated, _smooth
from eschorty_ros.core.line._window import BLOCK, FRACTION, ROW_BITS, TIME_LIMIT_US
from eschorty_ros.core.modulation.phase_gate import _outside

CLOSED, EMPTY, FILLED = 0, 1, 2
STATE = np.dtype(
    [
        ("period", np.int64),
        ("edge_us", np.int64),
        # CLOSED, EMPTY or FILLED
        ("open", np.int64),
        # half a window's width for the open period, fixed point
        ("half", np.int64),
        # points in the output
        ("points", np.int64),
    ]
)
_HALF_MIN = 3 * FRACTION
_WIDTH_MIN_DOF = 64


class EventArrays(NamedTuple):
    """Events in time order, arrays of equal length."""

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]


class Edges(NamedTuple):
    """Times and numbers of the beginnings of periods."""

    t_us: NDArray[np.int64]
    period: NDArray[np.int64]


class Points(NamedTuple):
    """Rows of closed periods as in `profiles.LineRows`; arrays of equal length."""

    period: NDArray[np.int64]
    edge_us: NDArray[np.int64]
    t_us: NDArray[np.int64]
    column: NDArray[np.uint16]
    row: NDArray[np.float64]
    sigma_row: NDArray[np.float64]
    width_px: NDArray[np.float64]
    events: NDArray[np.uint32]
    return_index: NDArray[np.uint8]


class Assembly(NamedTuple):
    """Memory and settings of the pass from events to points."""

    columns: Columns
    estimator: Estimator
    smoothing: Smoothing
    rows: Rows
    scratch: Scratch
    points: Points


class Progress(NamedTuple):
    """First event and first edge that are not dealt with."""

    event: int
    edge: int


@kernel
def _append(events, first, limit_us, columns, rows, gate, state, counters):
    """Append events before ``limit_us`` that the gate lets through; returns the first left."""
    t, x, y, p = events
    packed, counts = columns.packed, columns.counts
    size = np.uintp(counts.size)
    stride = np.uintp(packed.size) // size
    room = np.uint32(stride - np.uintp(BLOCK))
    edge_us = state.edge_us
    i = np.uintp(first)
    end = np.uintp(t.size)
    over = 0
    outside = 0
    gated = 0
    gating = gate.length_us > 0.0
    while i < end and t[i] < limit_us:
        c = np.uintp(x[i])
        r = np.uint32(y[i])
        dt = t[i] - edge_us
        if c < size and r < rows:
            n = counts[c]
            if gating and _outside(dt, p[i], gate):
                gated += 1
            elif n < room:
                packed[c * stride + np.uintp(n)] = np.uint32(
                    (np.uint32(min(dt, TIME_LIMIT_US - 1)) << np.uint32(ROW_BITS)) | r
                )
                counts[c] = n + np.uint32(1)
            else:
                over += 1
        else:
            outside += 1
        i += np.uintp(1)
    counters.events_binned += np.int64(i) - first - over - outside - gated
    counters.events_over_column_limit += over
    counters.events_outside_sensor += outside
    counters.events_gated += gated
    return np.int64(i)


@kernel
def _adapted_half(half, spread, half_max):
    """Window for the next period: 1.3 x the width that this period's rows show, averaged."""
    if spread.freedom < _WIDTH_MIN_DOF:
        return half
    wanted = HALF_PER_SIGMA * np.sqrt(spread.squares / spread.freedom)
    return np.int64(min(max(np.rint(0.5 * (half + wanted)), _HALF_MIN), half_max))


@kernel
def _emit(rows, smoothing, state, points):
    """Write the period's points behind ``state.points``, by column, nearest return first."""
    planes, columns = rows.row.shape
    i = state.points
    for c in range(columns):
        place = 0
        for k in range(planes):
            if np.isnan(rows.row[k, c]):
                continue
            points.period[i] = state.period
            points.edge_us[i] = state.edge_us
            points.t_us[i] = state.edge_us + rows.mean_dt_us[k, c]
            points.column[i] = c
            points.row[i] = smoothing.row[k, c]
            points.sigma_row[i] = np.sqrt(smoothing.sigma2[k, c])
            points.width_px[i] = np.sqrt(rows.variance[k, c])
            points.events[i] = rows.events[k, c]
            points.return_index[i] = place
            place += 1
            i += 1
    state.points = i


@kernel
def _close(assembly, state, counters):
    """Turn the open period into points."""
    columns, estimator, smoothing, rows, scratch, points = assembly
    counters.periods_closed += 1
    spread = _estimate_columns(columns, state.half, estimator, rows, scratch, counters)
    state.half = _adapted_half(state.half, spread, estimator.half_max)
    counters.columns_isolated += _reject_isolated(rows.row, rows.events, smoothing)
    counters.columns_smoothed += _smooth(rows.row, rows.sigma2, rows.common2, smoothing)
    _emit(rows, smoothing, state, points)


@kernel
def _bin(events, edges, progress, drain, gate, assembly, state, counters):
    """Merge events with edges from ``progress`` on.

    A period is closed when an event reaches its end or, with ``drain``, when the events are
    through. The result is short of all events and edges when the output has no room for another
    profile.
    """
    rows = np.uint32(assembly.estimator.rows)
    room = assembly.points.row.size - assembly.rows.row.size
    i, edge = progress
    t = events.t
    far = np.int64(1 << 62)
    while True:
        limit_us = edges.t_us[edge] if edge < edges.t_us.size else far
        if i < t.size and t[i] < limit_us:
            if state.open == CLOSED:
                begin = i
                while i < t.size and t[i] < limit_us:
                    i += 1
                counters.events_before_first_edge += i - begin
            else:
                i = _append(events, i, limit_us, assembly.columns, rows, gate, state, counters)
                state.open = FILLED
        if edge == edges.t_us.size or (i == t.size and not drain):
            return Progress(i, edge)
        if state.open == FILLED:
            if state.points > room:
                return Progress(i, edge)
            _close(assembly, state, counters)
        elif state.open == EMPTY:
            counters.periods_empty += 1
        state.open = EMPTY
        state.edge_us = edges.t_us[edge]
        state.period = edges.period[edge]
        edge += 1
