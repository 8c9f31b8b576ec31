"""A growing queue of rows over several vectors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class ArrayQueue:
    """Vectors of equal length that grow at the end and are dropped from at the beginning.

    - ``dtypes``: Those of the vectors.
    - ``capacity``: Rows before the first growth.
    """

    def __init__(self, dtypes: Iterable[DTypeLike], capacity: int) -> None:
        self._buffers = tuple(np.empty(capacity, dtype) for dtype in dtypes)
        self._first = 0
        self._end = 0

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """The queued rows: views valid until the next change."""
        return tuple(values[self._first : self._end] for values in self._buffers)

    def append(self, arrays: Sequence[NDArray[Any]]) -> None:
        """Copy rows to the end."""
        count = arrays[0].size
        if self._end + count > self._buffers[0].size:
            self._make_room(count)
        for buffer, values in zip(self._buffers, arrays, strict=True):
            buffer[self._end : self._end + count] = values
        self._end += count

    def drop(self, count: int) -> None:
        """Remove the first ``count`` rows."""
        self._first += count
        if self._first == self._end:
            self._first = self._end = 0

    def _make_room(self, count: int) -> None:
        held, arrays = len(self), self.arrays
        size = 2 * (held + count)
        if size > self._buffers[0].size:
            self._buffers = tuple(np.empty(size, values.dtype) for values in self._buffers)
        # In the same buffers they do not overlap: these have twice the room.
        for buffer, values in zip(self._buffers, arrays, strict=True):
            buffer[:held] = values
        self._first, self._end = 0, held
