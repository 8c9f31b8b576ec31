"""Analytic surfaces: plane, steps, sphere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes.scene import UniformReflectance, sheet


@dataclass(frozen=True)
class Plane(UniformReflectance):
    """Plane ``x = centre_mm + slope_stage (y - pivot_mm) + slope_column z``.

    The slopes are mm of range per mm across; (0, 0) faces the sensor.
    """

    centre_mm: float = 1320.0
    slope_stage: float = 0.0
    slope_column: float = 0.0
    pivot_mm: float = 0.0

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`; NaN for rays that do not meet the plane."""
        y, slope = sheet(stage_mm, columns, model)
        facing = 1.0 - self.slope_column * slope
        at_axis = self.centre_mm + model.b_mm + self.slope_stage * (y - self.pivot_mm)
        depth = np.full(np.broadcast_shapes(y.shape, slope.shape), np.nan)
        np.divide(at_axis, facing, out=depth, where=facing > 0.0)
        return np.where(depth > 0.0, depth - model.b_mm, np.nan)


@dataclass(frozen=True)
class Steps(UniformReflectance):
    """Flat levels on a grid of equal column bands and stage bands.

    A tile is at ``base_mm + column_levels_mm[i] + stage_levels_mm[j]``; the first and last
    stage band have no end. Walls between column bands run along the rays, so that no tile
    hides another. The default spans 207 mm around 1.32 m with steps from 2 to 76 mm. Between
    10 and 110 mm the stage crosses one large step: the laser line is 7 mm thick there, to
    its faint ends, and is on both levels over these 7 mm.
    """

    base_mm: float = 1320.0
    column_levels_mm: tuple[float, ...] = (0.0, 2.0, 5.0, 25.0, 60.0, 20.0, -40.0, -45.0)
    stage_levels_mm: tuple[float, ...] = (0.0, 2.0, -40.0, -38.0, -36.0, 40.0, 62.0, 60.0, 0.0)
    stage_band_mm: float = 25.0

    def __post_init__(self) -> None:
        if not self.column_levels_mm or not self.stage_levels_mm:
            raise ArgumentError("a stepped scene has no levels; give at least one per direction")
        if not self.stage_band_mm > 0.0:
            raise ArgumentError(f"stage_band_mm is {self.stage_band_mm!r}; choose a positive width")

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`."""
        stage = np.atleast_1d(np.asarray(stage_mm, dtype=np.float64))
        column = np.atleast_1d(np.asarray(columns, dtype=np.int64))
        across = np.array(self.column_levels_mm)
        along = np.array(self.stage_levels_mm)
        band = np.floor(stage / self.stage_band_mm).astype(np.int64)
        along_mm = along[np.clip(band, 0, along.size - 1)]
        across_mm = across[np.clip(column * across.size // model.columns, 0, across.size - 1)]
        return np.asarray(self.base_mm + along_mm[:, np.newaxis] + across_mm[np.newaxis, :])


@dataclass(frozen=True)
class Sphere(UniformReflectance):
    """Sphere at ``(range_mm, stage_mm, line_mm)``, with a flat backdrop or without one."""

    centre_range_mm: float = 1320.0
    centre_stage_mm: float = 50.0
    centre_line_mm: float = 0.0
    radius_mm: float = 40.0
    backdrop_mm: float | None = 1400.0

    def __post_init__(self) -> None:
        if not self.radius_mm > 0.0:
            raise ArgumentError(f"radius_mm is {self.radius_mm!r}; choose a positive radius")

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`; NaN beside the sphere without a backdrop."""
        y, slope = sheet(stage_mm, columns, model)
        depth = self.centre_range_mm + model.b_mm
        half_linear = depth + slope * self.centre_line_mm
        constant = (
            depth**2 + self.centre_line_mm**2 + (y - self.centre_stage_mm) ** 2 - self.radius_mm**2
        )
        discriminant = half_linear**2 - (1.0 + slope**2) * constant
        hit = (discriminant >= 0.0) & (half_linear > 0.0) & (constant > 0.0)
        root = np.sqrt(np.where(hit, discriminant, 0.0))
        # The near root as constant / (b + root): no cancellation between b and root.
        near = np.full(hit.shape, np.nan)
        np.divide(constant, half_linear + root, out=near, where=hit)
        near -= model.b_mm
        if self.backdrop_mm is None:
            return near
        return np.fmin(near, self.backdrop_mm)
