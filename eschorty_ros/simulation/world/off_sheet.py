"""The image of points beside the laser sheet, which is the plane in focus."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.optics import Calibration


class OffSheet(NamedTuple):
    """Row of each point, and the standard deviation of its blur over the rows; NaN for none."""

    row: Array
    blur_rows: Array


def off_sheet(
    calibration: Calibration, range_mm: Array, columns: NDArray[np.int64], beside_mm: float
) -> OffSheet:
    """Return the image of points ``beside_mm`` from the sheet, +y positive, behind a round pupil.

    Rays from a point to the pupil's centre and to its two ends cross the sheet, which the sensor
    images point by point, so their rows are exact; a disc's deviation is a quarter of its diameter.
    """
    model = calibration.model()
    along_mm, pupil_mm = model.pupil_mm
    radius_mm = 0.5 * model.focal_mm / calibration.f_number
    theta = math.radians(model.theta_deg)
    rows = []
    for end_mm in (0.0, radius_mm, -radius_mm):
        foot_mm, away_mm = along_mm - end_mm * math.cos(theta), pupil_mm - end_mm * math.sin(theta)
        share = beside_mm / (away_mm + beside_mm) if away_mm + beside_mm > 0.0 else math.nan
        rows.append(model.row(range_mm - (range_mm - foot_mm) * share, columns))
    middle, low, high = rows
    return OffSheet(middle, np.nan_to_num(np.abs(high - low)) / 4.0)
