"""An image of the recent events: an exponential time surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Decoder

# Age at which the brightness is 1/e.
_TAU_US = 30_000


class EventFrame:
    """Image whose brightness decays exponentially with the age of the pixel's newest event."""

    def __init__(self, columns: int, rows: int) -> None:
        self._decoder = Decoder(columns, rows)
        self._newest_us = np.full((rows, columns), -(1 << 62), dtype=np.int64)

    def push(self, data: Any) -> None:
        """Decode the next bytes of the EVT3 stream, which may start anywhere."""
        events = self._decoder.decode(data)
        self._newest_us[events.y, events.x] = events.t

    def render(self) -> NDArray[np.uint8]:
        """Return the image at the newest sensor time, (rows, columns) uint8."""
        image = np.zeros(self._newest_us.shape, dtype=np.uint8)
        now_us = self._decoder.time_us
        if now_us is None:
            return image
        recent = now_us - self._newest_us < 8 * _TAU_US
        age_us = (now_us - self._newest_us[recent]).astype(np.float64)
        image[recent] = np.rint(255.0 * np.exp(-np.maximum(age_us, 0.0) / _TAU_US))
        return image
