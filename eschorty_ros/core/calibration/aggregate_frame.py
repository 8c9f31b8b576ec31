"""All events of a capture as one picture: the count of each pixel."""

from __future__ import annotations

import numpy as np
from numba import int64, types, uint16, uint32
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import exact
from eschorty_ros.core.base.kernel import entry_kernel
from eschorty_ros.core.base.numbers import integer
from eschorty_ros.core.evt3 import Events
from eschorty_ros.core.optics import PIXELS_MAX

_COUNT_MAX = (1 << 32) - 1
_U2 = types.Array(uint16, 1, "C", readonly=True)


class AggregateFrame:
    """Events per pixel, both polarities together; its memory does not grow with the capture.

    Public attributes:
    - ``counts``: Shape (rows, columns).
    - ``events``: Events counted; those outside the sensor are not.
    """

    def __init__(self, columns: int, rows: int) -> None:
        integer("columns", columns, 1, PIXELS_MAX)
        integer("rows", rows, 1, PIXELS_MAX)
        self.counts = np.zeros((rows, columns), np.uint32)
        self.events = 0

    def add(self, events: Events) -> None:
        """Count ``events``, in any order.

        Raises ``ArgumentError`` when columns and rows are not uint16 arrays of one length.
        """
        x = exact("x", events.x, np.uint16)
        y = exact("y", events.y, np.uint16, x.size)
        self.events += _count(self.counts, x, y)

    def image(self) -> NDArray[np.uint8]:
        """Return the frame as a grey picture, (rows, columns); 1 in 1000 lit pixels is white."""
        lit = self.counts[self.counts > 0]
        if not lit.size:
            return np.zeros(self.counts.shape, np.uint8)
        white = max(float(np.quantile(lit, 0.999)), 1.0)
        # The root keeps faint posts visible beside bright ones.
        return np.rint(255.0 * np.sqrt(np.minimum(self.counts / white, 1.0))).astype(np.uint8)


@entry_kernel(int64(uint32[:, ::1], _U2, _U2))
def _count(counts, x, y):
    """Add each event on the sensor to its pixel, which saturates; return how many they are."""
    rows, columns = counts.shape
    inside = 0
    for i in range(x.size):
        if y[i] < rows and x[i] < columns:
            inside += 1
            if counts[y[i], x[i]] < _COUNT_MAX:
                counts[y[i], x[i]] += uint32(1)
    return inside
