"""The laser line on the pixels, drawn again only in the columns where it has changed."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.optics import Calibration
from eschorty_ros.simulation.pixels import PixelArray
from eschorty_ros.simulation.scenes import Scene
from eschorty_ros.simulation.world.effects import Effects
from eschorty_ros.simulation.world.line_on_scene import line_on_scene
from eschorty_ros.simulation.world.off_sheet import off_sheet

_ROW_STEP = 0.02
_REFLECTANCE_STEP = 0.01
_THICKNESS_STEP = 0.01
_SIGMA_MIN_ROWS = 0.5
"""Where a surface slopes towards the camera, its line is as thin as the lens images a point."""


class _Patches(NamedTuple):
    """Arguments of :meth:`PixelArray.relight`, shape (columns, patches)."""

    row: Array
    reflectance: Array
    sigma_rows: Array
    low_row: Array
    high_row: Array


class DrawnLine:
    """The line as drawn on the pixels."""

    def __init__(
        self, scene: Scene, calibration: Calibration, pixels: PixelArray, effects: Effects
    ) -> None:
        self._scene = scene
        self._calibration = calibration
        self._model = model = calibration.model()
        self._pixels = pixels
        self._effects = effects
        # A stage at rest leaves it as it is, from period to period.
        self._on_scene = lru_cache(maxsize=1)(partial(line_on_scene, scene, model))
        self._every_column = np.arange(model.columns)
        self._position_mm = np.nan
        self._level = 0.0
        self._row = np.full(model.columns, np.nan)
        self._reflectance = np.full(model.columns, np.nan)
        self._thickness = np.ones(model.columns)
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
        seen = self._on_scene(position_mm, half_rows)
        moved = ~(np.abs(seen.row - self._row) <= _ROW_STEP)
        moved &= ~(np.isnan(seen.row) & np.isnan(self._row))
        with np.errstate(invalid="ignore"):
            moved |= np.abs(seen.reflectance - self._reflectance) > _REFLECTANCE_STEP
            moved |= np.abs(seen.thickness - self._thickness) > _THICKNESS_STEP * seen.thickness
        moved |= self._was_split | (self._effects.ghost > 0.0)
        moved[seen.split] = False
        if moved.any():
            columns = self._every_column[moved]
            row, reflectance, thickness = (
                values[moved, np.newaxis] for values in (seen.row, seen.reflectance, seen.thickness)
            )
            whole = np.full_like(row, np.inf)
            parts = _Patches(row, reflectance, self._sigma_rows(thickness), -whole, whole)
            self._place(t_us, position_mm, columns, parts)
            for drawn, values in (
                (self._row, seen.row),
                (self._reflectance, seen.reflectance),
                (self._thickness, seen.thickness),
            ):
                drawn[moved] = values[moved]
        self._was_split[:] = False
        if seen.split.size:
            self._was_split[seen.split] = True
            sigma = self._sigma_rows(seen.patch_thickness)
            split = (seen.patch_row, seen.patch_reflectance, sigma, seen.low_row, seen.high_row)
            self._place(t_us, position_mm, seen.split, _Patches(*split))

    def _sigma_rows(self, thickness: Array) -> Array:
        return np.maximum(self._pixels.parameters.sigma_rows * thickness, _SIGMA_MIN_ROWS)

    def _place(
        self, t_us: int, position_mm: float, columns: NDArray[np.int64], patches: _Patches
    ) -> None:
        """Place patches on the pixels, out of focus and beside a ghost where there are these."""
        effects, model = self._effects, self._model
        each = columns[:, np.newaxis]
        if effects.defocus_mm:
            range_mm = model.range_mm(patches.row, each)
            off = off_sheet(self._calibration, range_mm, each, effects.defocus_mm)
            patches = _blurred(patches, off.blur_rows)
        if effects.ghost:
            there_mm = np.array([position_mm + effects.ghost_mm])
            range_mm = self._scene.range_mm(there_mm, columns, model).T
            ghost = off_sheet(self._calibration, range_mm, each, effects.ghost_mm)
            light = effects.ghost * self._scene.reflectance(there_mm, columns, model).T
            whole = np.full_like(light, np.inf)
            across = np.full_like(light, self._pixels.parameters.sigma_rows)
            added = _Patches(ghost.row, light, across, -whole, whole)
            pairs = zip(patches, _blurred(added, ghost.blur_rows), strict=True)
            patches = _Patches(*map(np.hstack, pairs))
        self._pixels.relight(
            t_us,
            columns,
            patches.row,
            patches.reflectance * self._level,
            patches.low_row,
            patches.high_row,
            patches.sigma_rows,
        )


def _blurred(patches: _Patches, blur_rows: Array) -> _Patches:
    """Return patches out of focus, with the same light on more rows."""
    sigma = np.hypot(patches.sigma_rows, blur_rows)
    reflectance = patches.reflectance * (patches.sigma_rows / sigma)
    return patches._replace(reflectance=reflectance, sigma_rows=sigma)
