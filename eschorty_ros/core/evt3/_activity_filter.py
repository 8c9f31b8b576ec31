"""Compiled background-activity filter on cells of 8 columns x 4 rows; see ``noise``."""

from __future__ import annotations

import numpy as np
from numba import int32, int64, types, uint8, uint16, uint64

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.evt3._decode import EVENT_ARRAYS

COLUMN_BITS = 3
ROW_BITS = 2
_PIXEL_BITS = COLUMN_BITS + ROW_BITS
_PIXEL_MASK = (1 << _PIXEL_BITS) - 1
_REBASE_US = 1 << 25
"""Cell times are relative to an origin that moves by this much, so that they fit 32 bits."""

NEVER = -(1 << 31)
# Filter state, one int64 each.
ORIGIN_US, STARTED = range(2)

_I8 = types.Array(int64, 1, "C", readonly=True)
_U2 = types.Array(uint16, 1, "C", readonly=True)
_U1 = types.Array(uint8, 1, "C", readonly=True)


@kernel((int32[::1], int64[::1], int64))
def _rebase(cells, s, t):
    """Move the origin to ``t``; cell times older than 32 bits can tell become 'never'."""
    shift = (t - s[ORIGIN_US]) << _PIXEL_BITS
    for k in range(cells.size):
        moved = np.int64(cells[k]) - shift
        cells[k] = np.int32(max(moved, np.int64(NEVER)))
    s[ORIGIN_US] = t


@kernel(types.boolean(int32[::1], uint64, uint64, int64))
def _neighbours_fresh(cells, cell, pitch, oldest):
    """Whether any of the 8 cells around ``cell`` holds a time of ``oldest`` or later."""
    one = np.uint64(1)
    above = cell - pitch
    below = cell + pitch
    return (
        cells[cell - one] >= oldest
        or cells[cell + one] >= oldest
        or cells[above] >= oldest
        or cells[below] >= oldest
        or cells[above - one] >= oldest
        or cells[above + one] >= oldest
        or cells[below - one] >= oldest
        or cells[below + one] >= oldest
    )


@kernel(
    types.Tuple((uint64, uint64))(
        _I8, _U2, _U2, _U1, EVENT_ARRAYS, int32[::1], int64[::1], int64, int64, int64, int64
    )
)
def _filter(t_in, x_in, y_in, p_in, out, cells, s, window, width, height, pitch_cells):
    """Compact the supported events into ``out``; returns kept and outside counts."""
    n = np.uint64(0)
    outside = np.uint64(0)
    pitch = np.uint64(pitch_cells)
    for index in range(t_in.size):
        k = np.uintp(index)
        t = t_in[k]
        x = np.uint64(x_in[k])
        y = np.uint64(y_in[k])
        if x >= np.uint64(width) or y >= np.uint64(height):
            outside += np.uint64(1)
            continue
        if t - s[ORIGIN_US] >= _REBASE_US:
            _rebase(cells, s, t)
        now = (t - s[ORIGIN_US]) << _PIXEL_BITS
        oldest = now - (window << _PIXEL_BITS)
        cell = ((y >> np.uint64(ROW_BITS)) + np.uint64(1)) * pitch + (
            (x >> np.uint64(COLUMN_BITS)) + np.uint64(1)
        )
        stamp = now | np.int64(((y & np.uint64(3)) << np.uint64(COLUMN_BITS)) | (x & np.uint64(7)))
        own = np.int64(cells[cell])
        # A pixel never supports itself: a hot one would.
        kept = (own >= oldest and (own ^ stamp) & _PIXEL_MASK != 0) or _neighbours_fresh(
            cells, cell, pitch, oldest
        )
        cells[cell] = np.int32(stamp)
        out.t[n] = t
        out.x[n] = np.uint16(x)
        out.y[n] = np.uint16(y)
        out.p[n] = p_in[k]
        n += np.uint64(kept)
    return n, outside
