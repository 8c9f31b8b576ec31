"""The region of interest: the columns and ranges that are reconstructed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.line.columns import Columns
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.settings import Settings


class SensorWindow(NamedTuple):
    """A window of the sensor, pixels: its first column and row, its width and height."""

    column: int
    row: int
    width: int
    height: int


class _Limits(NamedTuple):
    """Which columns are ``lit``, and the first and last row of each."""

    lit: NDArray[np.bool_]
    first: NDArray[np.float64]
    last: NDArray[np.float64]


def region(columns: Columns, settings: Settings, model: RangeModel) -> Columns:
    """Return ``columns`` that take only the rows of the region that ``settings`` give.

    A column's rows are those of the least and the largest range, and a line's width to either side:
    the line of a surface at the limit is complete.
    """
    lit, first, last = _limits(settings, model)
    if lit.all() and not first.any() and (last == model.rows - 1.0).all():
        return columns
    # A span of 0 from the largest number on has no row.
    return columns._replace(
        row_first=np.where(lit, np.ceil(first), 0xFFFFFFFF).astype(np.uint32),
        row_span=np.where(lit, np.floor(last) - np.ceil(first), 0).astype(np.uint32),
    )


def rows_taken(settings: Settings, model: RangeModel) -> int:
    """Return how many rows a column of the region has, their median."""
    lit, first, last = _limits(settings, model)
    rows = np.floor(last) - np.ceil(first) + 1.0
    return round(float(np.median(rows[lit]))) if lit.any() else model.rows


def region_window(settings: Settings, model: RangeModel) -> SensorWindow:
    """Return the least window of the sensor that holds the region that ``settings`` give.

    It is the full sensor for a region beside it.
    """
    lit, first, last = _limits(settings, model)
    if not lit.any():
        return SensorWindow(0, 0, model.columns, model.rows)
    top, bottom = int(np.ceil(first[lit].min())), int(np.floor(last[lit].max()))
    left = int(np.argmax(lit))
    return SensorWindow(left, top, int(np.count_nonzero(lit)), bottom - top + 1)


def _limits(settings: Settings, model: RangeModel) -> _Limits:
    """Return the limits of the region that ``settings`` give."""
    number = np.arange(model.columns)
    first, last = np.zeros(model.columns), np.full(model.columns, model.rows - 1.0)
    for range_m, rows, side in ((settings.range_min, first, -1), (settings.range_max, last, 1)):
        if range_m > 0.0:
            row = model.row(range_m * 1e3, number) + side * settings.line_width_px
            rows[:] = np.where(np.isfinite(row), np.clip(row, 0.0, model.rows - 1.0), rows)
    lit = (number >= settings.column_first) & (number <= settings.column_last)
    return _Limits(lit, first, last)


def within_ranges(range_mm: NDArray[np.float64], settings: Settings) -> NDArray[np.bool_]:
    """Return true where a range is in the region; never where it is NaN."""
    last_m = settings.range_max if settings.range_max > 0.0 else np.inf
    return (range_mm >= settings.range_min * 1e3) & (range_mm <= last_m * 1e3)
