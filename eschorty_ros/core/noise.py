"""Background-activity filter: an event stays only when its neighbourhood fired shortly before.

The nearest-neighbour rule of Delbruck, "Frame-free dynamic digital vision" (2008), on cells of
4 x 4 pixels instead of single ones: the time and pixel of each cell's newest event are kept, and
support is any other pixel of the 3 x 3 cells around the event's own within the window. Single
pixels would lose the first event of each 3 x 3 neighbourhood of a laser burst, one in nine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import int32, int64, njit, types, uint8, uint16, uint64

from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.evt3 import Events, event_arrays

_CELL_BITS = 2
_PIXEL_BITS = 2 * _CELL_BITS
_REBASE_US = 1 << 26
"""Cell times are relative to an origin that moves by this much, so that they fit 32 bits."""

_NEVER = -(1 << 31)
_WINDOW_MAX_US = 1_000_000

# Filter state, one int64 each.
_ORIGIN_US, _STARTED = range(2)

_I8 = types.Array(int64, 1, "C", readonly=True)
_U2 = types.Array(uint16, 1, "C", readonly=True)
_U1 = types.Array(uint8, 1, "C", readonly=True)
_OUT = types.Tuple((int64[::1], uint16[::1], uint16[::1], uint8[::1]))


@njit((int32[::1], int64[::1], int64), cache=True, nogil=True)
def _rebase(cells, s, t):
    """Move the origin to ``t``; cell times older than 32 bits can tell become 'never'."""
    shift = (t - s[_ORIGIN_US]) << _PIXEL_BITS
    for k in range(cells.size):
        moved = np.int64(cells[k]) - shift
        cells[k] = np.int32(max(moved, np.int64(_NEVER)))
    s[_ORIGIN_US] = t


@njit(types.boolean(int32[::1], uint64, uint64, int64), cache=True, nogil=True)
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


@njit(
    types.Tuple((uint64, uint64))(
        _I8, _U2, _U2, _U1, _OUT, int32[::1], int64[::1], int64, int64, int64, int64
    ),
    cache=True,
    nogil=True,
)
def _filter(t_in, x_in, y_in, p_in, out, cells, s, window, width, height, pitch_cells):
    """Compact the supported events into ``out``; returns kept and outside counts."""
    t_out, x_out, y_out, p_out = out
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
        if t - s[_ORIGIN_US] >= _REBASE_US:
            _rebase(cells, s, t)
        now = (t - s[_ORIGIN_US]) << _PIXEL_BITS
        oldest = now - (window << _PIXEL_BITS)
        cell = ((y >> np.uint64(_CELL_BITS)) + np.uint64(1)) * pitch + (
            (x >> np.uint64(_CELL_BITS)) + np.uint64(1)
        )
        stamp = now | np.int64(((y & np.uint64(3)) << np.uint64(2)) | (x & np.uint64(3)))
        own = np.int64(cells[cell])
        # A pixel never supports itself: a hot one would.
        kept = (own >= oldest and (own ^ stamp) & 0xF != 0) or _neighbours_fresh(
            cells, cell, pitch, oldest
        )
        cells[cell] = np.int32(stamp)
        t_out[n] = t
        x_out[n] = np.uint16(x)
        y_out[n] = np.uint16(y)
        p_out[n] = p_in[k]
        n += np.uint64(kept)
    return n, outside


@dataclass(frozen=True, slots=True)
class FilterCounters:
    """Events kept, removed for lack of support, and dropped for lying outside the sensor."""

    kept: int = 0
    removed: int = 0
    outside: int = 0


class ActivityFilter:
    """Streaming background-activity filter; the result does not depend on how events are split.

    Parameters
    ----------
    width, height : int
        Sensor size in pixels, 1 to 2048.
    window_us : int
        Longest age of a supporting event, 1 to 1 000 000 us. The default spans a laser edge's
        burst and leaves a 10 Hz pixel of background a small chance of support.

    Raises
    ------
    ArgumentError
        When a value lies outside its range.

    Notes
    -----
    Times must not fall, as a decoder guarantees. Triggers pass unchanged.
    """

    def __init__(self, width: int = 1280, height: int = 720, window_us: int = 500) -> None:
        for name, size in (("width", width), ("height", height)):
            if not 1 <= size <= 2048:
                raise ArgumentError(f"{name} is {size!r}; choose 1 to 2048 pixels")
        if not 1 <= window_us <= _WINDOW_MAX_US:
            raise ArgumentError(f"window_us is {window_us!r}; choose 1 to {_WINDOW_MAX_US} us")
        self.width, self.height, self.window_us = int(width), int(height), int(window_us)
        # One cell of border on each side, so that no neighbour needs a check.
        self._pitch = ((self.width + 3) >> _CELL_BITS) + 2
        self._size = self._pitch * (((self.height + 3) >> _CELL_BITS) + 2)
        self._buffers = event_arrays(0)
        self.reset()

    def reset(self) -> None:
        """Forget all events and counts."""
        self._cells = np.full(self._size, _NEVER, dtype=np.int32)
        self._state = np.zeros(2, dtype=np.int64)
        self._counts = [0, 0, 0]

    @property
    def counters(self) -> FilterCounters:
        """Snapshot of the counts since construction or ``reset``."""
        return FilterCounters(*self._counts)

    def filter(self, events: Events) -> Events:
        """Supported events of ``events``: views of reused buffers, valid until the next call."""
        size = len(events)
        if len(self._buffers[0]) < size + 1:
            self._buffers = event_arrays(size + 1)
        if size and not self._state[_STARTED]:
            self._state[_ORIGIN_US], self._state[_STARTED] = events.t[0], 1
        kept, outside = _filter(
            events.t,
            events.x,
            events.y,
            events.p,
            self._buffers,
            self._cells,
            self._state,
            self.window_us,
            self.width,
            self.height,
            self._pitch,
        )
        for k, count in enumerate((kept, size - kept - outside, outside)):
            self._counts[k] += int(count)
        t, x, y, p = self._buffers
        return Events(t[:kept], x[:kept], y[:kept], p[:kept], events.triggers)
