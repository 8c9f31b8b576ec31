"""A scene moved into another build's range."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes.scene import Scene

NAMED_MM = 838.0, 1450.0
"""Span that holds every named scene; a build that sees all of it sees them as they are."""


@dataclass(frozen=True)
class WithinRange:
    """A scene whose ranges are stretched and moved along the rays; the sweep stays as it is.

    ``new range = offset_mm + factor * range``.
    """

    scene: Scene
    factor: float
    offset_mm: float

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`."""
        return self.offset_mm + self.factor * self.scene.range_mm(stage_mm, columns, model)

    def reflectance(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the reflectance where the rays hit."""
        return self.scene.reflectance(stage_mm, columns, model)


def within_range(scene: Scene, model: RangeModel) -> Scene:
    """Return a named scene as a build sees it: moved into its range where it would be outside."""
    near_mm, far_mm = model.range_limits_mm
    low, high = NAMED_MM
    if near_mm <= low and far_mm >= high:
        return scene
    # A pole on the sensor puts the last row at infinity.
    far_mm = min(far_mm, near_mm * high / low) if far_mm > near_mm else near_mm * high / low
    factor = (far_mm - near_mm) / (high - low)
    return WithinRange(scene, factor, near_mm - factor * low)
