"""The laser line on the pixels, drawn again only in the columns where it has changed."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.pixels import PixelArray
from eschorty_ros.simulation.scenes import Scene
from eschorty_ros.simulation.world.footprint import footprint

_ROW_STEP = 0.02
_REFLECTANCE_STEP = 0.01


class DrawnLine:
    """The line as drawn on the pixels.

    Parameters
    ----------
    scene : Scene
    model : RangeModel
    pixels : PixelArray
    """

    def __init__(self, scene: Scene, model: RangeModel, pixels: PixelArray) -> None:
        self._scene = scene
        self._model = model
        self._pixels = pixels
        self._every_column = np.arange(model.columns)
        self._position_mm = np.nan
        self._level = 0.0
        self._row = np.full(model.columns, np.nan)
        self._reflectance = np.full(model.columns, np.nan)
        self._was_split = np.zeros(model.columns, dtype=bool)

    def redraw(self) -> None:
        """Draw every column the next time, which is necessary after a change of thresholds."""
        self._row[:] = np.nan
        self._position_mm = np.nan

    def draw(self, t_us: int, position_mm: float, level: float) -> None:
        """Draw the line on the scene at a stage position, with the laser at ``level``."""
        if level != self._level:
            self.redraw()
            self._level = level
        if position_mm != self._position_mm:
            self._draw_at(t_us, position_mm)
            self._position_mm = position_mm

    def remove(self, t_us: int) -> None:
        """Remove the line."""
        dark = np.zeros(self._model.columns)
        self._pixels.relight(t_us, self._every_column, self._row, dark)
        self._level = 0.0

    def _draw_at(self, t_us: int, position_mm: float) -> None:
        half_rows = self._pixels.parameters.half_width_rows
        seen = footprint(self._scene, self._model, position_mm, half_rows)
        moved = ~(np.abs(seen.row - self._row) <= _ROW_STEP)
        moved &= ~(np.isnan(seen.row) & np.isnan(self._row))
        with np.errstate(invalid="ignore"):
            moved |= np.abs(seen.reflectance - self._reflectance) > _REFLECTANCE_STEP
        moved |= self._was_split
        moved[seen.split] = False
        if moved.any():
            columns = self._every_column[moved]
            self._pixels.relight(
                t_us, columns, seen.row[moved], seen.reflectance[moved] * self._level
            )
            self._row[moved] = seen.row[moved]
            self._reflectance[moved] = seen.reflectance[moved]
        self._was_split[:] = False
        if seen.split.size:
            self._was_split[seen.split] = True
            self._pixels.relight(
                t_us,
                seen.split,
                seen.patch_row,
                seen.patch_reflectance * self._level,
                seen.low_row,
                seen.high_row,
            )
