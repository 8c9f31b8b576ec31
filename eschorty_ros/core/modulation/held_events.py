"""Events that cannot be assigned to a period yet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import exact, whole


class HeldEvents:
    """A growing queue of events in time order.

    Attributes
    ----------
    t, x, y, p : ndarray of int64, uint16, uint16, uint8
        The queued events: views valid until the next change.
    refused : int
        Leading events in which no phase was found.
    """

    def __init__(self) -> None:
        self._t = np.empty(4096, dtype=np.int64)
        self._x = np.empty(4096, dtype=np.uint16)
        self._y = np.empty(4096, dtype=np.uint16)
        self._p = np.empty(4096, dtype=np.uint8)
        self._first = 0
        self._end = 0
        self.refused = 0

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def t(self) -> NDArray[np.int64]:
        """Times, us."""
        return self._t[self._first : self._end]

    @property
    def x(self) -> NDArray[np.uint16]:
        """Columns."""
        return self._x[self._first : self._end]

    @property
    def y(self) -> NDArray[np.uint16]:
        """Rows."""
        return self._y[self._first : self._end]

    @property
    def p(self) -> NDArray[np.uint8]:
        """Polarities."""
        return self._p[self._first : self._end]

    def append(
        self,
        t: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        p: NDArray[np.uint8],
    ) -> None:
        """Copy events to the end."""
        count = exact("t", t, np.int64).size
        x, y = exact("x", x, np.uint16, count), exact("y", y, np.uint16, count)
        p = exact("p", p, np.uint8, count)
        if self._end + count > len(self._t):
            self._make_room(count)
        new = slice(self._end, self._end + count)
        self._t[new], self._x[new], self._y[new], self._p[new] = t, x, y, p
        self._end += count

    def drop(self, count: int) -> None:
        """Forget the first ``count`` events."""
        whole("count", count, 0, len(self))
        self._first += count
        self.refused = max(self.refused - count, 0)
        if self._first == self._end:
            self._first = self._end = 0

    def _make_room(self, count: int) -> None:
        held = len(self)
        size = max(len(self._t), 2 * (held + count))
        for name in ("_t", "_x", "_y", "_p"):
            old = getattr(self, name)
            new = np.empty(size, dtype=old.dtype)
            new[:held] = old[self._first : self._end]
            setattr(self, name, new)
        self._first, self._end = 0, held
