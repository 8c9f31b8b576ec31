"""Events of a period sorted into columns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel, record, with_names
from eschorty_ros.core.line.window import BLOCK, ROW_BITS, TIME_LIMIT_US, TIME_SHIFT
from eschorty_ros.core.modulation.phase_gate import _gate_part

_ROOM = 128
# Room for padding. With it a column's two places are an odd number of cache lines, so that those to
# which events are appended are in all sets of the cache.
PADDING = BLOCK + 8
_ALL_ROWS = np.empty(0, np.uint32)


class Columns(NamedTuple):
    """Packed events by column: ``counts[c]`` of them from ``starts[c]`` on.

    A column's place is followed by that of the late events of a `PhaseGate` that keeps them, those
    of ``starts[columns + c]``: appended to the others they find room there.

    - ``seeds``: Row of the line in the last period, fixed point; -1 for none.
    - ``second_rows``: Row of a second line that is nearly as strong; -1 for none.
    - ``second_seen``: Profiles in which that line has been at its rows.
    - ``excess``: Events that the first line has had more than the second; 0 for none.
    - ``events``: Events of the first line.
    - ``room``, ``limit``: Room for the events of a column, and what it may grow to.
    - ``row_first``, ``row_span``: In a region of interest the first row that a column takes, and
      how many rows follow it; empty without one.
    - ``refused``: Events that `_bin` did not append, by reason.
    """

    packed: NDArray[np.uint32]
    starts: NDArray[np.int64]
    counts: NDArray[np.uint32]
    seeds: NDArray[np.int64]
    second_rows: NDArray[np.int64]
    second_seen: NDArray[np.int64]
    excess: NDArray[np.float64]
    events: NDArray[np.int64]
    room: int
    limit: int
    row_first: NDArray[np.uint32]
    row_span: NDArray[np.uint32]
    refused: Any


class Bins(NamedTuple):
    """Where `_bin` puts the events of a part of the period, which begins at ``edge_us``.

    Events before ``floor_us`` count as at that time. ``late_on`` and ``late_off`` are the number of
    columns where a gate has ON and OFF events as late, which it keeps apart or drops, and 0 where
    not.
    """

    packed: NDArray[np.uint32]
    counts: NDArray[np.uint32]
    room: np.uint32
    row_first: NDArray[np.uint32]
    row_span: NDArray[np.uint32]
    refused: Any
    late_on: np.uintp
    late_off: np.uintp
    keeps_late: bool
    edge_us: np.int64
    floor_us: np.int64


def empty_columns(columns: int, limit: int, room: int = _ROOM) -> Columns:
    """Return ``columns`` empty columns with ``room`` for events each, and ``limit`` at most."""
    room = min(room, limit)
    size = room + PADDING
    return Columns(
        packed=np.empty(2 * columns * size, np.uint32),
        starts=np.arange(2 * columns).reshape(columns, 2).T.ravel() * size,
        counts=np.zeros(2 * columns, np.uint32),
        seeds=np.full(columns, -1, np.int64),
        second_rows=np.full(columns, -1, np.int64),
        second_seen=np.zeros(columns, np.int64),
        excess=np.zeros(columns),
        events=np.zeros(columns, np.int64),
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
    wider = empty_columns(columns.seeds.size, columns.limit, 2 * columns.room)
    wider.packed.reshape(size, -1)[:, : packed.shape[1]] = packed
    return columns._replace(packed=wider.packed, starts=wider.starts, room=wider.room)


def grouped_columns(rows: NDArray[np.uint32], offsets: NDArray[np.int64]) -> Columns:
    """Return columns of which ``c`` has the events ``rows[offsets[c]:offsets[c + 1]]``."""
    counts = np.diff(offsets)
    sizes = counts + BLOCK
    starts = np.cumsum(sizes) - sizes
    packed = np.empty(int(sizes.sum()), np.uint32)
    packed[np.arange(rows.size) + np.repeat(starts - offsets[:-1], counts)] = rows
    return empty_columns(counts.size, 0, 0)._replace(
        packed=packed,
        starts=starts,
        counts=counts.astype(np.uint32),
    )


@kernel(_nrt=False)
def _clear_refused(refused):
    refused.over_limit = 0
    refused.outside_region = 0
    refused.gated = 0


@kernel(_nrt=False)
def _late(bins, polarity):
    return bins.late_on if polarity else bins.late_off


@kernel(_nrt=False)
def _is_selected(bins, c, r, late):
    """Return whether region and gate take an event, or count why not."""
    if bins.row_first.size > 0 and np.uint32(r - bins.row_first[c]) > bins.row_span[c]:
        bins.refused.outside_region += 1
        return False
    if late and not bins.keeps_late:
        bins.refused.gated += 1
        return False
    return True


def _append_event(bins, n, t_us, column, row, polarity):
    """Append an event to its column, or count why not: a decoder's ``emit``."""
    # An array that is bound to a name here is counted as used for every event.
    c, r = np.uintp(column), np.uint32(row)
    dt = max(t_us, bins.floor_us) - bins.edge_us
    late = _late(bins, polarity)
    place = c + late
    events = bins.counts[place]
    if not _is_selected(bins, c, r, late):
        return n + np.uint64(1)
    if events < bins.room:
        slot = np.uintp(2) * c + np.uintp(late > 0)
        at = slot * np.uintp(bins.room + np.uint32(PADDING))
        bins.packed[at + np.uintp(events)] = np.uint32(
            (np.uint32(min(dt, TIME_LIMIT_US - 1)) << TIME_SHIFT)
            | (np.uint32(polarity) << np.uint32(ROW_BITS))
            | r
        )
        bins.counts[place] = events + np.uint32(1)
    else:
        bins.refused.over_limit += 1
    return n + np.uint64(1)


@kernel(_nrt=False)
def _never_late(bins, polarity):
    return np.uintp(0)


@kernel(_nrt=False)
def _selects_all(bins, c, r, late):
    return True


_bin = with_names(_append_event, "some")
_bin_all = with_names(_append_event, "all", _late=_never_late, _is_selected=_selects_all)


@kernel(_nrt=False)
def _needs_room(columns):
    """Return whether events found no room in columns that may grow."""
    return columns.refused.over_limit > 0 and columns.room < columns.limit


@kernel(inline="always")
def _bins(columns, part, keeps_late, edge_us, floor_us):
    """Return the bins of a part of the period."""
    late = np.uintp(columns.seeds.size)
    return Bins(
        columns.packed, columns.counts, np.uint32(columns.room), columns.row_first,
        columns.row_span, columns.refused, late * np.uintp(part.late_on),
        late * np.uintp(part.late_off), keeps_late, edge_us, floor_us,
    )  # fmt: skip


@kernel
def _append(events, first, limit_us, edge_us, columns, gate):
    """Append the events before ``limit_us`` to their columns, or count why not.

    Returns the index of the first event not read, and whether a column needs more room: then no
    event has been read.
    """
    t, x, y, p = events
    before = columns.counts.copy()
    _clear_refused(columns.refused)
    i = np.uintp(first)
    end = np.uintp(t.size)
    while i < end and t[i] < limit_us:
        part = _gate_part(max(t[i], edge_us), edge_us, gate)
        bins = _bins(columns, part, gate.keeps_late > 0, edge_us, edge_us)
        end_us = min(part.end_us, limit_us)
        while i < end and t[i] < end_us:
            _bin(bins, np.uint64(0), t[i], x[i], y[i], p[i])
            i += np.uintp(1)
    if _needs_room(columns):
        columns.counts[:] = before
        return np.int64(first), True
    return np.int64(i), False
