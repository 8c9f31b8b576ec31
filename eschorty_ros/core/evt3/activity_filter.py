"""Background-activity filter: an event stays only when its neighbourhood fired shortly before.

The nearest-neighbour rule of Delbruck, "Frame-free dynamic digital vision" (2008), on cells of
8 columns x 4 rows instead of single pixels: the time and pixel of each cell's newest event are
kept, and support is any other pixel of the 3 x 3 cells around the event's own within the window.
Single pixels would lose the first event of each 3 x 3 neighbourhood of a laser burst, one in
nine; the cells are wide because the line runs along the columns.
"""

from __future__ import annotations

import numpy as np
from numba import int32, int64, typeof, types, uint8, uint16, uint64

from eschorty_ros.core.base.arrays import exact
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import entry_kernel, kernel, record
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer
from eschorty_ros.core.evt3.events import EVENT_ARRAYS, Events, _first_fall, event_arrays
from eschorty_ros.core.evt3.words import ADDRESSES

_COLUMN_BITS = 3
_ROW_BITS = 2
_PIXEL_BITS = _COLUMN_BITS + _ROW_BITS
_PIXEL_MASK = (1 << _PIXEL_BITS) - 1
_REBASE_US = 1 << 25
"""Cell times are relative to an origin that moves by this much, so that they fit 32 bits."""

_NEVER = -(1 << 31)
_STATE = ("origin_us", "started", "window_us", "width", "height", "pitch")

_WINDOW_MAX_US = 1_000_000


class ActivityFilter:
    """Streaming background-activity filter; the result does not depend on how events are split.

    Times must not fall, from call to call either, as a decoder guarantees. Triggers pass unchanged.

    - ``width``, ``height``: Sensor size in pixels, 1 to 2048.
    - ``window_us``: Longest age of a supporting event, 1 to 1 000 000 us. The default spans a laser
      edge's burst; a longer one keeps hardly more of the line and more background.

    Raises ``ArgumentError`` when a value is outside its range.
    """

    def __init__(self, width: int = 1280, height: int = 720, window_us: int = 500) -> None:
        self.width = integer("width", width, 1, ADDRESSES)
        self.height = integer("height", height, 1, ADDRESSES)
        self.window_us = integer("window_us", window_us, 1, _WINDOW_MAX_US)
        # One cell of border on each side, so that no neighbour needs a check.
        self._pitch = ((self.width + 7) >> _COLUMN_BITS) + 2
        self._buffers = event_arrays(0)
        size = self._pitch * (((self.height + 3) >> _ROW_BITS) + 2)
        self._cells = np.full(size, _NEVER, dtype=np.int32)
        self._state = record(*_STATE)
        state = self._state
        state["window_us"], state["pitch"] = self.window_us, self._pitch
        state["width"], state["height"] = self.width, self.height
        self._newest_us = -TIME_LIMIT

    def filter(self, events: Events) -> Events:
        """Return the supported events: views of reused buffers, valid until the next call.

        Raises ``ArgumentError`` when the arrays are not those of a decoder, or times fall.
        """
        t_us = exact("t", events.t, np.int64)
        size = t_us.size
        columns = exact("x", events.x, np.uint16, size)
        rows = exact("y", events.y, np.uint16, size)
        polarities = exact("p", events.p, np.uint8, size)
        fall = _first_fall(t_us, self._newest_us)
        if fall >= 0:
            raise ArgumentError(f"t[{fall}] is {t_us[fall]} us; sort the events by time")
        if len(self._buffers[0]) < size + 1:
            self._buffers = event_arrays(size + 1)
        if size and not self._state["started"]:
            self._state["origin_us"], self._state["started"] = t_us[0], 1
        if size:
            self._newest_us = int(t_us[-1])
        kept = _filter(t_us, columns, rows, polarities, self._buffers, self._cells, self._state)
        t, x, y, p = self._buffers
        return Events(t[:kept], x[:kept], y[:kept], p[:kept], events.triggers)


_S = typeof(record(*_STATE))
_I8 = types.Array(int64, 1, "C", readonly=True)
_U2 = types.Array(uint16, 1, "C", readonly=True)
_U1 = types.Array(uint8, 1, "C", readonly=True)


@kernel
def _rebase(cells, s, t):
    """Move the origin to ``t``; cell times too old for 32 bits become ``_NEVER``."""
    shift = (t - s.origin_us) << _PIXEL_BITS
    for k in range(cells.size):
        moved = np.int64(cells[k]) - shift
        cells[k] = np.int32(max(moved, np.int64(_NEVER)))
    s.origin_us = t


@kernel
def _neighbours_fresh(cells, cell, pitch, oldest):
    """Return whether any of the 8 cells around ``cell`` holds a time of ``oldest`` or later."""
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


@entry_kernel(uint64(_I8, _U2, _U2, _U1, EVENT_ARRAYS, int32[::1], _S))
def _filter(t_in, x_in, y_in, p_in, out, cells, s):
    """Compact the supported events into ``out``; return their number."""
    t_out, x_out, y_out, p_out = out
    n = np.uint64(0)
    pitch = np.uint64(s.pitch)
    for index in range(t_in.size):
        k = np.uintp(index)
        t = t_in[k]
        x = np.uint64(x_in[k])
        y = np.uint64(y_in[k])
        if x >= np.uint64(s.width) or y >= np.uint64(s.height):
            continue
        if t - s.origin_us >= _REBASE_US:
            _rebase(cells, s, t)
        now = (t - s.origin_us) << _PIXEL_BITS
        oldest = now - (s.window_us << _PIXEL_BITS)
        cell = ((y >> np.uint64(_ROW_BITS)) + np.uint64(1)) * pitch + (
            (x >> np.uint64(_COLUMN_BITS)) + np.uint64(1)
        )
        stamp = now | np.int64(((y & np.uint64(3)) << np.uint64(_COLUMN_BITS)) | (x & np.uint64(7)))
        own = np.int64(cells[cell])
        # A pixel never supports itself: a hot one would.
        kept = (own >= oldest and (own ^ stamp) & _PIXEL_MASK != 0) or _neighbours_fresh(
            cells, cell, pitch, oldest
        )
        cells[cell] = np.int32(stamp)
        t_out[n] = t
        x_out[n] = np.uint16(x)
        y_out[n] = np.uint16(y)
        p_out[n] = p_in[k]
        n += np.uint64(kept)
    return n
