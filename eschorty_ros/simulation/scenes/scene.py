"""The interface of a scene, and common parts of scenes.

All scenes are in ``eschorty_base``: x is the range, y the stage direction, z the laser line.
At stage position ``s`` the sheet is a fan of rays from ``(-b, s, 0)`` with the direction
``(1, 0, column_slope)``, so the range of a hit is its x coordinate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.optics import RangeModel


class Scene(Protocol):
    """A surface the laser sheet can hit."""

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the range (mm) of every ray's first hit, shape (n, m); NaN where there is none.

        - ``stage_mm``: Shape (n,).
        - ``columns``: Shape (m,).
        - ``model``: Gives the ray origin (``b_mm``) and the slope of each column.
        """

    def reflectance(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the reflectance (0 to 1) where the rays of :meth:`range_mm` hit, same shape."""


def sheet(stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> tuple[Array, Array]:
    """Return stage positions as (n, 1) and ray slopes (mm of z per mm of depth) as (1, m)."""
    stage = np.atleast_1d(np.asarray(stage_mm, dtype=np.float64))
    return stage[:, np.newaxis], model.column_slope(np.atleast_1d(columns))[np.newaxis, :]


class RecentRays:
    """The result of the last query: range and reflectance of the same rays need one cast."""

    def __init__(self) -> None:
        self._last: tuple[Any, tuple[Array, NDArray[Any]]] | None = None

    def get(
        self,
        cast: Callable[[ArrayLike, ArrayLike, RangeModel], tuple[Array, NDArray[Any]]],
        stage_mm: ArrayLike,
        columns: ArrayLike,
        model: RangeModel,
    ) -> tuple[Array, NDArray[Any]]:
        """Return ``cast(stage_mm, columns, model)``, its arrays made read-only."""
        rays = (np.asarray(values, dtype=np.float64).tobytes() for values in (stage_mm, columns))
        key = (*rays, model)
        if self._last is None or self._last[0] != key:
            result = cast(stage_mm, columns, model)
            for array in result:
                array.setflags(write=False)
            self._last = (key, result)
        return self._last[1]


class UniformReflectance:
    """A surface of uniform reflectance."""

    albedo: float = 1.0

    def reflectance(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the same value for every ray, shape (n, m)."""
        return np.full((np.size(stage_mm), np.size(columns)), self.albedo)
