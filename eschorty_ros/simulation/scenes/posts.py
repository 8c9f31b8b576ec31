"""Posts at known ranges side by side along the laser line, targets of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes.scene import UniformReflectance, sheet

RANGES_MM = (820.0, 960.0, 1110.0, 1270.0, 1440.0, 1610.0, 1770.0, 1910.0, 2050.0)
"""A third of them is in the far third of the third build's ranges."""
SLIM_MM, WIDE_MM = 12.7, 25.4
_SLIM_WITHIN_MM = 1000.0
_FAN_SLOPE = 0.0287


@dataclass(frozen=True, slots=True)
class Post:
    """One post along the stage direction, as long as any sweep."""

    range_mm: float
    """Range of its front."""
    line_mm: float
    """Position of its middle along the laser line (z)."""
    size_mm: float
    """Width of a flat post, diameter of a round one."""
    round: bool = False
    """A cylinder instead of a flat strip that faces the sensor."""

    def __post_init__(self) -> None:
        for name in ("range_mm", "size_mm"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise ArgumentError(f"a post's {name} is {value!r}; choose a positive length")
        if not np.isfinite(self.line_mm):
            raise ArgumentError(f"a post's line_mm is {self.line_mm!r}; choose a finite number")

    def front_mm(self, slope: Array, model: RangeModel) -> Array:
        """Return the range of the first hit of rays with these slopes; NaN beside the post."""
        depth = self.range_mm + model.b_mm
        if not self.round:
            beside = np.abs(slope * depth - self.line_mm) > 0.5 * self.size_mm
            return np.where(beside, np.nan, self.range_mm)
        radius = 0.5 * self.size_mm
        axis = depth + radius
        half_linear = axis + slope * self.line_mm
        square = 1.0 + slope * slope
        constant = axis**2 + self.line_mm**2 - radius**2
        discriminant = half_linear**2 - square * constant
        root = np.sqrt(np.where(discriminant >= 0.0, discriminant, np.nan))
        # The near root as constant / (b + root): no cancellation between b and root.
        return np.asarray(constant / (half_linear + root) - model.b_mm)

    def columns(self, model: RangeModel) -> tuple[float, float]:
        """Return the columns (fractional) between which the post appears."""
        depth = self.range_mm + model.b_mm
        if self.round:
            radius = 0.5 * self.size_mm
            axis = depth + radius
            middle = np.arctan2(self.line_mm, axis)
            half = np.arcsin(radius / np.hypot(axis, self.line_mm))
            slopes = float(np.tan(middle - half)), float(np.tan(middle + half))
        else:
            ends = (self.line_mm - 0.5 * self.size_mm, self.line_mm + 0.5 * self.size_mm)
            slopes = ends[0] / depth, ends[1] / depth
        per_slope = model.k_mm / (model.pixel_um * 1e-3)
        left, right = (model.principal_column + float(s) * per_slope for s in slopes)
        return left, right


def bench(ranges_mm: Sequence[float] = RANGES_MM) -> tuple[Post, ...]:
    """Return flat posts at these ranges, each in the middle of its share of the fan.

    Slim and wide posts alternate, so that blooming is not taken for a size; the nearest are slim,
    because a wide one would fill its share.

    Raises ``ArgumentError`` for more posts than fit side by side.
    """
    if len(ranges_mm) > len(RANGES_MM):
        raise ArgumentError(
            f"{len(ranges_mm)} posts do not fit side by side; choose {len(RANGES_MM)} at most"
        )
    posts = []
    for index, range_mm in enumerate(ranges_mm):
        slim = index % 2 == 1 or range_mm < _SLIM_WITHIN_MM
        line_mm = (index - 0.5 * (len(ranges_mm) - 1)) * _FAN_SLOPE * range_mm
        posts.append(Post(range_mm, line_mm, SLIM_MM if slim else WIDE_MM))
    return tuple(posts)


@dataclass(frozen=True)
class Posts(UniformReflectance):
    """Posts with nothing behind them, or with a flat backdrop."""

    posts: Sequence[Post] = field(default_factory=bench)
    """In any order; the nearest one in a column is seen."""
    backdrop_mm: float | None = None
    """Range of the backdrop."""

    def __post_init__(self) -> None:
        if not self.posts:
            raise ArgumentError("a scene of posts has none; give at least one Post")

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`; NaN between the posts."""
        stage, slope = sheet(stage_mm, columns, model)
        nearest = np.full(slope.shape, np.nan if self.backdrop_mm is None else self.backdrop_mm)
        for post in self.posts:
            nearest = np.fmin(nearest, post.front_mm(slope, model))
        return np.repeat(nearest, stage.shape[0], axis=0)
