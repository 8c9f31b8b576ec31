"""A scene whose brightness falls with the square of its range."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes import Scene


class Falloff:
    """A :class:`Scene` with the reflectance times ``(full_mm / range)**2``, at most 1."""

    def __init__(self, scene: Scene, full_mm: float) -> None:
        self._scene = scene
        self._full_mm = full_mm

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the scene's ranges."""
        return self._scene.range_mm(stage_mm, columns, model)

    def reflectance(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the reflectance that the scene seems to have; 0 where it is not hit."""
        share = (self._full_mm / self.range_mm(stage_mm, columns, model)) ** 2
        dimmed = self._scene.reflectance(stage_mm, columns, model) * np.minimum(share, 1.0)
        return np.nan_to_num(dimmed)
