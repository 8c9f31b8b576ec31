"""All events of a capture as one picture: how many every pixel sent."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import exact, whole
from eschorty_ros.core.calibration._aggregate import count_events
from eschorty_ros.core.optics import PIXELS_MAX


class Pixels(Protocol):
    """Events with columns ``x`` and rows ``y``, as the decoder hands them out."""

    @property
    def x(self) -> NDArray[np.uint16]:
        """Columns."""

    @property
    def y(self) -> NDArray[np.uint16]:
        """Rows."""


class AggregateFrame:
    """Events per pixel, both polarities together; its memory does not grow with the capture.

    Parameters
    ----------
    columns, rows : int

    Attributes
    ----------
    counts : ndarray of uint32, shape (rows, columns)
    events : int
        Events counted.
    outside : int
        Events outside the sensor, not counted.
    """

    def __init__(self, columns: int, rows: int) -> None:
        whole("columns", columns, 1, PIXELS_MAX)
        whole("rows", rows, 1, PIXELS_MAX)
        self.counts = np.zeros((rows, columns), np.uint32)
        self.events = 0
        self.outside = 0

    def add(self, events: Pixels) -> None:
        """Count ``events``, in any order.

        Raises
        ------
        ArgumentError
            When columns and rows are not uint16 arrays of one length.
        """
        x = exact("x", events.x, np.uint16)
        y = exact("y", events.y, np.uint16, x.size)
        outside = count_events(self.counts, x, y)
        self.outside += outside
        self.events += x.size - outside

    def image(self) -> NDArray[np.uint8]:
        """Draw the frame, (rows, columns) uint8; the brightest of 1000 pixels is white."""
        lit = self.counts[self.counts > 0]
        if not lit.size:
            return np.zeros(self.counts.shape, np.uint8)
        white = max(float(np.quantile(lit, 0.999)), 1.0)
        # The root keeps faint posts visible beside bright ones.
        return np.rint(255.0 * np.sqrt(np.minimum(self.counts / white, 1.0))).astype(np.uint8)
