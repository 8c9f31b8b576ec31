"""Events of a period sorted into columns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.line.window import BLOCK, ROW_BITS, TIME_LIMIT_US, TIME_SHIFT
from eschorty_ros.core.modulation.phase_gate import PhaseGate, _outside

_ROOM = 128
_ALL_ROWS = np.empty(0, np.uint32)


class Columns(NamedTuple):
    """Packed events by column: ``counts`` of them from ``starts`` on, with room for padding.

    The ``room`` for events grows up to ``limit``. ``seeds`` are the rows of the lines in the last
    period, fixed point; -1 for none. ``rivals`` are those of second lines that are nearly as
    strong, and ``evidence`` the events by which the first ones have been stronger. In a region of
    interest column ``c`` takes ``row_first[c]`` and the ``row_span[c]`` rows behind it; without one
    both are empty. ``refused`` counts the events that `_bin` did not append, by reason.
    """

    packed: NDArray[np.uint32]
    starts: NDArray[np.int64]
    counts: NDArray[np.uint32]
    seeds: NDArray[np.int64]
    rivals: NDArray[np.int64]
    evidence: NDArray[np.float64]
    room: int
    limit: int
    row_first: NDArray[np.uint32]
    row_span: NDArray[np.uint32]
    refused: Any


class Bins(NamedTuple):
    """Where `_bin` puts the events of a period, which begins at ``edge_us``.

    Events before ``floor_us`` count as at that time.
    """

    packed: NDArray[np.uint32]
    counts: NDArray[np.uint32]
    room: np.uint32
    row_first: NDArray[np.uint32]
    row_span: NDArray[np.uint32]
    refused: Any
    gate: PhaseGate
    edge_us: np.int64
    floor_us: np.int64


class Appended(NamedTuple):
    """Index of the first event not read, and the number of events outside the sensor.

    ``full`` when a column needs more room: then no event has been read.
    """

    next: np.int64
    full: bool
    outside: int


def empty_columns(columns: int, limit: int, room: int = _ROOM) -> Columns:
    """Return ``columns`` empty columns with ``room`` for events each, and ``limit`` at most."""
    room = min(room, limit)
    stride = room + BLOCK
    return Columns(
        packed=np.empty(columns * stride, np.uint32),
        starts=np.arange(columns) * stride,
        counts=np.zeros(columns, np.uint32),
        seeds=np.full(columns, -1, np.int64),
        rivals=np.full(columns, -1, np.int64),
        evidence=np.zeros(columns),
        room=room,
        limit=limit,
        row_first=_ALL_ROWS,
        row_span=_ALL_ROWS,
        refused=record("over_limit", "outside_region", "gated"),
    )


def wider_columns(columns: Columns) -> Columns:
    """Return the same columns with twice the room, or all that the limit allows."""
    size = columns.counts.size
    packed = columns.packed.reshape(size, -1)
    wider = empty_columns(size, columns.limit, 2 * columns.room)
    wider.packed.reshape(size, -1)[:, : packed.shape[1]] = packed
    return columns._replace(packed=wider.packed, starts=wider.starts, room=wider.room)


def grouped_columns(rows: NDArray[np.uint32], offsets: NDArray[np.int64]) -> Columns:
    """Return columns of which ``c`` has the events ``rows[offsets[c]:offsets[c + 1]]``."""
    counts = np.diff(offsets)
    sizes = -(-counts // BLOCK) * BLOCK
    starts = np.cumsum(sizes) - sizes
    packed = np.empty(int(sizes.sum()), np.uint32)
    packed[np.arange(rows.size) + np.repeat(starts - offsets[:-1], counts)] = rows
    return empty_columns(counts.size, 0, 0)._replace(
        packed=packed, starts=starts, counts=counts.astype(np.uint32)
    )


@kernel(_nrt=False)
def _forget_refused(refused):
    refused.over_limit = 0
    refused.outside_region = 0
    refused.gated = 0


@kernel(_nrt=False)
def _bin(bins, n, t_us, column, row, polarity):
    """Append an event to its column, or count why not: a decoder's ``emit``."""
    # An array that is bound to a name here is counted as used for every event.
    c, r = np.uintp(column), np.uint32(row)
    dt = max(t_us, bins.floor_us) - bins.edge_us
    if bins.row_first.size > 0 and np.uint32(r - bins.row_first[c]) > bins.row_span[c]:
        bins.refused.outside_region += 1
    elif bins.gate.length_us > 0.0 and _outside(dt, polarity, bins.gate):
        bins.refused.gated += 1
    else:
        events = bins.counts[c]
        if events < bins.room:
            bins.packed[c * np.uintp(bins.room + np.uint32(BLOCK)) + np.uintp(events)] = np.uint32(
                (np.uint32(min(dt, TIME_LIMIT_US - 1)) << TIME_SHIFT)
                | (np.uint32(polarity) << np.uint32(ROW_BITS))
                | r
            )
            bins.counts[c] = events + np.uint32(1)
        else:
            bins.refused.over_limit += 1
    return n + np.uint64(1)


@kernel(_nrt=False)
def _needs_room(columns):
    """Return true when events found no room in columns that may grow."""
    return columns.refused.over_limit > 0 and columns.room < columns.limit


@kernel
def _append(events, first, limit_us, edge_us, columns, rows, gate):
    """Append the events before ``limit_us`` that pass the gate to `empty_columns`."""
    t, x, y, p = events
    before = columns.counts.copy()
    _forget_refused(columns.refused)
    bins = Bins(
        columns.packed, columns.counts, np.uint32(columns.room), columns.row_first,
        columns.row_span, columns.refused, gate, edge_us, edge_us,
    )  # fmt: skip
    size = np.uintp(columns.counts.size)
    rows_end = np.uint32(rows)
    i = np.uintp(first)
    end = np.uintp(t.size)
    outside = 0
    while i < end and t[i] < limit_us:
        if np.uintp(x[i]) < size and np.uint32(y[i]) < rows_end:
            _bin(bins, np.uint64(0), t[i], x[i], y[i], p[i])
        else:
            outside += 1
        i += np.uintp(1)
    if _needs_room(columns):
        columns.counts[:] = before
        return Appended(np.int64(first), True, 0)
    return Appended(np.int64(i), False, outside)
