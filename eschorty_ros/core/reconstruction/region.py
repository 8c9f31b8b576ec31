"""The region of interest: the columns and ranges that are reconstructed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.line.columns import Columns
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.settings import Settings


def region(columns: Columns, settings: Settings, model: RangeModel) -> Columns:
    """Return ``columns`` that take only the rows of the region that ``settings`` give.

    A column's rows are those of the least and the largest range, and a line's width to either side:
    the line of a surface at the limit is complete.
    """
    number = np.arange(model.columns)
    first, last = np.zeros(model.columns), np.full(model.columns, model.rows - 1.0)
    for range_m, rows, side in ((settings.range_min, first, -1), (settings.range_max, last, 1)):
        if range_m > 0.0:
            row = model.row(range_m * 1e3, number) + side * settings.line_width_px
            rows[:] = np.where(np.isfinite(row), np.clip(row, 0.0, model.rows - 1.0), rows)
    lit = (number >= settings.column_first) & (number <= settings.column_last)
    if lit.all() and not first.any() and (last == model.rows - 1.0).all():
        return columns
    # No row is within a span of 0 behind the largest number.
    return columns._replace(
        row_first=np.where(lit, np.ceil(first), 0xFFFFFFFF).astype(np.uint32),
        row_span=np.where(lit, np.floor(last) - np.ceil(first), 0).astype(np.uint32),
    )


def within_ranges(range_mm: NDArray[np.float64], settings: Settings) -> NDArray[np.bool_]:
    """Return true where a range is in the region; never where it is NaN."""
    last_m = settings.range_max if settings.range_max > 0.0 else np.inf
    return (range_mm >= settings.range_min * 1e3) & (range_mm <= last_m * 1e3)
