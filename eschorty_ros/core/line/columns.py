"""Events of a period sorted into columns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.window import BLOCK, ROW_BITS, TIME_LIMIT_US, TIME_SHIFT
from eschorty_ros.core.modulation.phase_gate import _outside

_ROOM = 128
_ALL_ROWS = np.empty(0, np.uint32)


class Columns(NamedTuple):
    """Packed events by column: ``counts`` of them from ``starts`` on, with room for padding.

    The room for events grows up to ``limit``. ``seeds`` are the rows of the lines in the last
    period, fixed point; -1 for none. ``rivals`` are those of second lines that are nearly as
    strong, and ``evidence`` the events by which the first ones have been stronger. In a region of
    interest column ``c`` takes ``row_first[c]`` and the ``row_span[c]`` rows behind it; without one
    both are empty.
    """

    packed: NDArray[np.uint32]
    starts: NDArray[np.int64]
    counts: NDArray[np.uint32]
    seeds: NDArray[np.int64]
    rivals: NDArray[np.int64]
    evidence: NDArray[np.float64]
    limit: int
    row_first: NDArray[np.uint32]
    row_span: NDArray[np.uint32]


class Appended(NamedTuple):
    """Index of the first event not read, and the numbers of events not appended, by reason.

    ``full`` when a column needs more room: then no event has been read.
    """

    next: np.int64
    full: bool
    over_limit: int
    outside: int
    outside_region: int
    gated: int


def empty_columns(columns: int, limit: int, room: int = _ROOM) -> Columns:
    """Return ``columns`` empty columns with ``room`` for events each, and ``limit`` at most."""
    stride = min(room, limit) + BLOCK
    return Columns(
        packed=np.empty(columns * stride, np.uint32),
        starts=np.arange(columns) * stride,
        counts=np.zeros(columns, np.uint32),
        seeds=np.full(columns, -1, np.int64),
        rivals=np.full(columns, -1, np.int64),
        evidence=np.zeros(columns),
        limit=limit,
        row_first=_ALL_ROWS,
        row_span=_ALL_ROWS,
    )


def wider_columns(columns: Columns) -> Columns:
    """Return the same columns with twice the room, or all that the limit allows."""
    size = columns.counts.size
    packed = columns.packed.reshape(size, -1)
    wider = empty_columns(size, columns.limit, 2 * (packed.shape[1] - BLOCK))
    wider.packed.reshape(size, -1)[:, : packed.shape[1]] = packed
    return columns._replace(packed=wider.packed, starts=wider.starts)


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


@kernel
def _append(events, first, limit_us, edge_us, columns, rows, gate):
    """Append the events before ``limit_us`` that pass the gate to `empty_columns`."""
    t, x, y, p = events
    packed, counts = columns.packed, columns.counts
    before = counts.copy()
    size = np.uintp(counts.size)
    stride = np.uintp(packed.size) // size
    room = np.uint32(stride - np.uintp(BLOCK))
    rows_end = np.uint32(rows)
    i = np.uintp(first)
    end = np.uintp(t.size)
    over_limit = 0
    outside = 0
    outside_region = 0
    gated = 0
    row_first, row_span = columns.row_first, columns.row_span
    bounded = row_first.size > 0
    gating = gate.length_us > 0.0
    while i < end and t[i] < limit_us:
        c = np.uintp(x[i])
        r = np.uint32(y[i])
        dt = t[i] - edge_us
        if c < size and r < rows_end:
            n = counts[c]
            if bounded and np.uint32(r - row_first[c]) > row_span[c]:
                outside_region += 1
            elif gating and _outside(dt, p[i], gate):
                gated += 1
            elif n < room:
                packed[c * stride + np.uintp(n)] = np.uint32(
                    (np.uint32(min(dt, TIME_LIMIT_US - 1)) << TIME_SHIFT)
                    | (np.uint32(p[i]) << np.uint32(ROW_BITS))
                    | r
                )
                counts[c] = n + np.uint32(1)
            else:
                over_limit += 1
        else:
            outside += 1
        i += np.uintp(1)
    if over_limit > 0 and np.int64(room) < columns.limit:
        counts[:] = before
        return Appended(np.int64(first), True, 0, 0, 0, 0)
    return Appended(np.int64(i), False, over_limit, outside, outside_region, gated)
