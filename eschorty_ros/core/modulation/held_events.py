"""Events that cannot be assigned to a period yet."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_CAPACITY = 1 << 19
_DTYPES = (np.int64, np.uint16, np.uint16, np.uint8)

HELD_EVENTS_MAX = 1 << 22
"""Events that wait for a phase, or for the periods of a profile, at most."""

Arrays = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""Times in us (int64), columns (uint16), rows (uint16) and polarities (uint8)."""


class HeldEvents:
    """A growing queue of events in time order.

    Public attributes:
    - ``searched``: Leading events in which no phase was found.
    - ``refused``: Events dropped because they waited for a phase or for light too long, or until
      the stream ended.
    """

    def __init__(self) -> None:
        self._buffers = tuple(np.empty(_CAPACITY, dtype) for dtype in _DTYPES)
        self._first = 0
        self._end = 0
        self.searched = self.refused = 0

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def arrays(self) -> Arrays:
        """The queued events: views valid until the next change."""
        t, x, y, p = (values[self._first : self._end] for values in self._buffers)
        return t, x, y, p

    def append(self, events: Arrays) -> None:
        """Copy events to the end."""
        count = events[0].size
        if self._end + count > self._buffers[0].size:
            self._make_room(count)
        for buffer, values in zip(self._buffers, events, strict=True):
            buffer[self._end : self._end + count] = values
        self._end += count

    def drop(self, count: int) -> None:
        """Remove the first ``count`` events."""
        self._first += count
        self.searched = max(self.searched - count, 0)
        if self._first == self._end:
            self._first = self._end = 0

    def refuse(self, count: int) -> None:
        """Remove the first ``count`` events, which nothing can use."""
        self.refused += count
        self.drop(count)

    def _make_room(self, count: int) -> None:
        held = len(self)
        size = max(self._buffers[0].size, 2 * (held + count))
        grown = tuple(np.empty(size, dtype) for dtype in _DTYPES)
        for new, old in zip(grown, self.arrays, strict=True):
            new[:held] = old
        self._buffers = grown
        self._first, self._end = 0, held
