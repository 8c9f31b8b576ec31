"""The rows that the camera reads out: at their first and last row a line is cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3.words import ADDR_Y, ADDRESSES
from eschorty_ros.core.optics import Calibration, RangeModel


def window_model(calibration: Calibration) -> tuple[int, RangeModel]:
    """Return the first row that is read out, and the range model of the rows from there on."""
    model = calibration.model()
    if calibration.roi_px is None:
        return 0, model
    _, first, _, rows = calibration.roi_px
    return first, replace(model, rows=rows, b_prime_px=model.b_prime_px + first)


def window_words(words: NDArray[np.uint16], first: int) -> NDArray[np.uint16]:
    """Return the EVT3 ``words`` with rows from ``first``; earlier ones are past the window."""
    mask = np.uint16(ADDRESSES - 1)
    row = (words & ~mask) | ((words & mask) - np.uint16(first) & mask)
    moved = np.where(words >> 12 == ADDR_Y, row, words)
    # As the decoder's words.
    moved.flags.writeable = False
    return moved
