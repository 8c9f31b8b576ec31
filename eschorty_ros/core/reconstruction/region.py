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
    lit, first, last = _limits(settings, model)
    if lit.all() and not first.any() and (last == model.rows - 1.0).all():
        return columns
    # No row is within a span of 0 behind the largest number.
    return columns._replace(
        row_first=np.where(lit, np.ceil(first), 0xFFFFFFFF).astype(np.uint32),
        row_span=np.where(lit, np.floor(last) - np.ceil(first), 0).astype(np.uint32),
    )


def rows_taken(settings: Settings, model: RangeModel) -> int:
    """Return how many rows a column of the region has, their median."""
    lit, first, last = _limits(settings, model)
    rows = np.floor(last) - np.ceil(first) + 1.0
    return round(float(np.median(rows[lit]))) if lit.any() else model.rows


def region_window(settings: Settings, model: RangeModel) -> tuple[int, int, int, int]:
    """Return the least window of the sensor that holds the region that ``settings`` give.

    First column, first row, width and height in pixels; the full sensor for a region beside it.
    """
    lit, first, last = _limits(settings, model)
    if not lit.any():
        return 0, 0, model.columns, model.rows
    top, bottom = int(np.ceil(first[lit].min())), int(np.floor(last[lit].max()))
    left = int(np.argmax(lit))
    return left, top, int(np.count_nonzero(lit)), bottom - top + 1


def _limits(
    settings: Settings, model: RangeModel
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Return which columns are in the region, and the first and last row of each."""
    number = np.arange(model.columns)
    first, last = np.zeros(model.columns), np.full(model.columns, model.rows - 1.0)
    for range_m, rows, side in ((settings.range_min, first, -1), (settings.range_max, last, 1)):
        if range_m > 0.0:
            row = model.row(range_m * 1e3, number) + side * settings.line_width_px
            rows[:] = np.where(np.isfinite(row), np.clip(row, 0.0, model.rows - 1.0), rows)
    return (number >= settings.column_first) & (number <= settings.column_last), first, last


def within_ranges(range_mm: NDArray[np.float64], settings: Settings) -> NDArray[np.bool_]:
    """Return true where a range is in the region; never where it is NaN."""
    last_m = settings.range_max if settings.range_max > 0.0 else np.inf
    return (range_mm >= settings.range_min * 1e3) & (range_mm <= last_m * 1e3)
