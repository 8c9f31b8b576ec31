"""Background-activity filter: an event stays only when its neighbourhood fired shortly before.

The nearest-neighbour rule of Delbruck, "Frame-free dynamic digital vision" (2008), on cells of
8 columns x 4 rows instead of single pixels: the time and pixel of each cell's newest event are
kept, and support is any other pixel of the 3 x 3 cells around the event's own within the window.
Single pixels would lose the first event of each 3 x 3 neighbourhood of a laser burst, one in
nine; the cells are wide because the line runs along the columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eschorty_ros.core.base.arrays import TIME_LIMIT, exact, whole
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3._activity_filter import (
    COLUMN_BITS,
    NEVER,
    ORIGIN_US,
    ROW_BITS,
    STARTED,
    _filter,
)
from eschorty_ros.core.evt3._encode import _first_fall
from eschorty_ros.core.evt3.decoder import Events, event_arrays

_WINDOW_MAX_US = 1_000_000


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
        burst; a longer one keeps hardly more of the line and more background.

    Raises
    ------
    ArgumentError
        When a value lies outside its range.

    Notes
    -----
    Times must not fall, from call to call either, as a decoder guarantees. Triggers pass
    unchanged.
    """

    def __init__(self, width: int = 1280, height: int = 720, window_us: int = 500) -> None:
        for name, size in (("width", width), ("height", height)):
            whole(name, size, 1, 2048)
        whole("window_us", window_us, 1, _WINDOW_MAX_US)
        self.width, self.height, self.window_us = int(width), int(height), int(window_us)
        # One cell of border on each side, so that no neighbour needs a check.
        self._pitch = ((self.width + 7) >> COLUMN_BITS) + 2
        self._size = self._pitch * (((self.height + 3) >> ROW_BITS) + 2)
        self._buffers = event_arrays(0)
        self.reset()

    def reset(self) -> None:
        """Forget all events and counts."""
        self._cells = np.full(self._size, NEVER, dtype=np.int32)
        self._state = np.zeros(2, dtype=np.int64)
        self._counts = [0, 0, 0]
        self._newest_us = -TIME_LIMIT

    @property
    def counters(self) -> FilterCounters:
        """Snapshot of the counts since construction or ``reset``."""
        return FilterCounters(*self._counts)

    def filter(self, events: Events) -> Events:
        """Supported events of ``events``: views of reused buffers, valid until the next call.

        Raises
        ------
        ArgumentError
            When the arrays are not those of a decoder, or times fall.
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
        if size and not self._state[STARTED]:
            self._state[ORIGIN_US], self._state[STARTED] = t_us[0], 1
        if size:
            self._newest_us = int(t_us[-1])
        kept, outside = _filter(
            t_us,
            columns,
            rows,
            polarities,
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
