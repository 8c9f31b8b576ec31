"""Events that cannot be assigned to a period yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.array_queue import ArrayQueue

_CAPACITY = 1 << 19
_DTYPES = (np.int64, np.uint16, np.uint16, np.uint8)

HELD_EVENTS_MAX = 1 << 22
"""Events that wait for a phase, or for the periods of a profile, at most."""

Arrays = tuple[NDArray[Any], ...]
"""Times in us (int64), columns (uint16), rows (uint16) and polarities (uint8)."""


NO_EVENTS: Arrays = tuple(np.empty(0, dtype) for dtype in _DTYPES)


def sample(events: Sequence[NDArray[Any]], most: int) -> Arrays:
    """Return less than twice as many events as ``most``, evenly spread."""
    stride = max(events[0].size // most, 1)
    return tuple(values[::stride] for values in events)


class HeldEvents(ArrayQueue):
    """A growing queue of events in time order.

    Public attributes:
    - ``searched``: Leading events in which no phase was found.
    - ``refused``: Events dropped because they waited for a phase or for light too long, or until
      the stream ended.
    """

    def __init__(self) -> None:
        super().__init__(_DTYPES, _CAPACITY)
        self.searched = self.refused = 0

    def drop(self, count: int) -> None:
        """Remove the first ``count`` events."""
        super().drop(count)
        self.searched = max(self.searched - count, 0)

    def refuse(self, count: int) -> None:
        """Remove the first ``count`` events, which nothing can use."""
        self.refused += count
        self.drop(count)
