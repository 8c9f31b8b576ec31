"""Rows of the line, the points they become, and the points' place in space."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from typing import Any, NamedTuple, Self, get_args, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import exact, reals, selection, vector
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import entry_kernel, kernel
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer, short
from eschorty_ros.core.optics import POLE_MARGIN_PX, RangeModel
from eschorty_ros.core.optics.range_model import (
    range_of_image_mm,
    sigma_of_image_mm,
    slope_of_column,
)
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE

_range_of_image_mm = kernel(inline="always")(range_of_image_mm)
_sigma_of_image_mm = kernel(inline="always")(sigma_of_image_mm)
_slope_of_column = kernel(inline="always")(slope_of_column)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LineRows:
    """Rows of the line: `Profiles` without the ranges."""

    period: NDArray[np.int64]
    edge_us: NDArray[np.int64]
    t_us: NDArray[np.int64]
    column: NDArray[np.uint16]
    row: NDArray[np.float64]
    sigma_row: NDArray[np.float64]
    events: NDArray[np.uint32]
    width_px: NDArray[np.float64]
    return_index: NDArray[np.uint8]
    flags: NDArray[np.uint16]
    reflectance: NDArray[np.float64] | None = None
    reflectance_sigma: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.column)

    @classmethod
    @cache
    def empty(cls) -> Self:
        """Return no rows."""
        names = {item.name for item in fields(cls)} & _DTYPES.keys()
        return cls(**{name: np.empty(0, _DTYPES[name]) for name in names})

    @classmethod
    def concatenate(cls, parts: Iterable[Self]) -> Self:
        """Return all rows of ``parts`` in their order.

        A reflectance that only some parts have is NaN in the others.
        """
        kept = [part for part in parts if len(part)]
        if not kept:
            return cls.empty()
        if len(kept) == 1:
            return kept[0]
        if any(part.reflectance is not None for part in kept):
            kept = [part if part.reflectance is not None else part._unknown() for part in kept]
        joined: dict[str, Any] = {}
        for item in fields(cls):
            values = [getattr(part, item.name) for part in kept]
            joined[item.name] = None if values[0] is None else np.concatenate(values)
        return cls(**joined)

    def select(self, mask: ArrayLike | slice) -> Self:
        """Return the rows of a boolean mask, a slice or an index array."""
        picked = mask if isinstance(mask, slice) else selection("mask", mask, len(self))
        chosen = self._values()
        for name, values in chosen.items():
            chosen[name] = None if values is None else values[picked]
        return type(self)(**chosen)

    def _values(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def _unknown(self) -> Self:
        """Return the rows with a reflectance of NaN."""
        nothing = np.full(len(self), np.nan)
        return replace(self, reflectance=nothing, reflectance_sigma=nothing)


class _Scale(NamedTuple):
    """Constants of Eq. 2; the row offset is by column."""

    offset_px: NDArray[np.float64]
    product_mm_px: float
    b_mm: float


@lru_cache(maxsize=8)
def _scale(model: RangeModel) -> _Scale:
    offset_px = np.array(model.row_offset_px(np.arange(model.columns)))
    return _Scale(offset_px, model.product_mm_px, float(model.b_mm))


@entry_kernel
def _fill_ranges(row, sigma_row, column, scale, range_mm, sigma_mm):
    """Set ranges and deviations in one pass; return how many are NaN."""
    beyond = 0
    for i in range(np.uintp(row.size)):
        image_px = row[i] + scale.offset_px[column[i]]
        known = image_px <= -POLE_MARGIN_PX
        image_px = image_px if known else np.nan
        range_mm[i] = _range_of_image_mm(image_px, scale.product_mm_px, scale.b_mm)
        sigma_mm[i] = _sigma_of_image_mm(image_px, sigma_row[i], scale.product_mm_px)
        beyond += not known
    return beyond


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Profiles(LineRows):
    """Points of complete profiles as arrays of equal length, by period, column and return index.

    Attributes
    ----------
    period : int64
        Index of the modulation period the profile begins with.
    edge_us : int64
        Rising edge that begins it, sensor time.
    t_us : int64
        Time of the light on the surface, sensor time: the mean time of the events used, less the
        delay of the stream's events behind the middle of the light where it is known.
    column : uint16
    row : float64
        Row of the line, px.
    sigma_row : float64
        Standard deviation of the row, px.
    events : uint32
        Events used.
    width_px : float64
        Sample standard deviation of the rows used; 0 for a single event.
    return_index : uint8
        Place among the points of the same profile and column, nearest range first.
    flags : uint16
        Bits ``MIXED``, ``SENSOR_EDGE`` and ``FEW_EVENTS``; 0 for a good point.
    reflectance : float64, optional
        Relative reflectance; ``None`` where it is not estimated.
    reflectance_sigma : float64, optional
        Standard deviation of the relative reflectance.
    range_mm : float64
        Range along the sheet (Eq. 2).
    sigma_mm : float64
        Standard deviation of the range.
    """

    range_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]

    @classmethod
    def from_rows(cls, rows: LineRows, model: RangeModel) -> Profiles:
        """Return ``rows`` with their ranges; those at the pole and behind it are left out."""
        range_mm, sigma_mm = np.empty((2, len(rows)))
        if _fill_ranges(rows.row, rows.sigma_row, rows.column, _scale(model), range_mm, sigma_mm):
            known = np.isfinite(range_mm)
            rows, range_mm, sigma_mm = rows.select(known), range_mm[known], sigma_mm[known]
        return cls(**rows._values(), range_mm=range_mm, sigma_mm=sigma_mm)

    @property
    def profile_count(self) -> int:
        """Number of different profiles."""
        edge_us = self.edge_us
        return int(np.count_nonzero(edge_us[1:] != edge_us[:-1])) + 1 if len(self) else 0


def _innermost(hint: Any) -> Any:
    """Return the last argument of ``hint``, at any depth: that of an array is its scalar type.

    From numpy 2.5 on, with Python 3.12, ``NDArray`` is an alias with one argument.
    """
    while arguments := get_args(hint):
        hint = arguments[-1]
    return hint


_DTYPES = {
    name: scalar
    for name, hint in get_type_hints(Profiles).items()
    if issubclass(scalar := _innermost(hint), np.generic)
}
"""Type of each array of `Profiles` but the optional ones."""


def place_link(profiles: Profiles, model: RangeModel, origin_us: int = 0) -> NDArray[np.void]:
    """Return the points in the moving frame ``eschorty_link``: x = range, z along the line, y = 0.

    They have POINT_DTYPE, or REFLECTANCE_DTYPE where the profiles have a reflectance, and shape
    (len(profiles),), in metres and seconds; ``sigma`` is the range's standard deviation.

    - ``origin_us``: Sensor time that counts as ``t = 0``, subtracted before the conversion to
      float.

    Raises ``ArgumentError`` when an array of the profiles has another dtype or length.
    """
    known = profiles.reflectance is not None
    origin_us = integer("origin_us", origin_us, -TIME_LIMIT, TIME_LIMIT)
    points = np.empty(len(profiles), dtype=REFLECTANCE_DTYPE if known else POINT_DTYPE)
    measured = (
        exact(name, getattr(profiles, name), _DTYPES[name], len(profiles))
        for name in _Measured._fields
    )
    lateral = _Lateral(float(model.principal_column), model.slope_per_column, float(model.b_mm))
    _fill_link(_Measured(*measured), lateral, origin_us, points)
    if known:
        points["reflectance"] = profiles.reflectance
        points["reflectance_sigma"] = profiles.reflectance_sigma
    return points


class _Measured(NamedTuple):
    """Arrays of `Profiles` that a point is made of."""

    range_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]
    t_us: NDArray[np.int64]
    column: NDArray[np.uint16]
    events: NDArray[np.uint32]
    flags: NDArray[np.uint16]


class _Lateral(NamedTuple):
    """Constants of `RangeModel.lateral_mm`."""

    principal_column: float
    slope_per_column: float
    b_mm: float


@entry_kernel
def _fill_link(measured, lateral, origin_us, points):
    """Set all fields of points in the moving frame but those of a reflectance."""
    for i in range(np.uintp(points.size)):
        slope = _slope_of_column(
            measured.column[i], lateral.principal_column, lateral.slope_per_column
        )
        depth_mm = measured.range_mm[i] + lateral.b_mm
        lateral_mm = slope * depth_mm if depth_mm > 0.0 else np.nan
        points[i].x = measured.range_mm[i] * 1e-3
        points[i].y = 0.0
        points[i].z = lateral_mm * 1e-3
        points[i].intensity = measured.events[i]
        points[i].sigma = measured.sigma_mm[i] * 1e-3
        points[i].t = (measured.t_us[i] - origin_us) * 1e-6
        points[i].column = measured.column[i]
        points[i].flags = measured.flags[i]


def place(
    profiles: Profiles,
    model: RangeModel,
    stage_position_mm: ArrayLike,
    stage_direction: ArrayLike,
    origin_us: int = 0,
) -> NDArray[np.void]:
    """Return the points in ``eschorty_base``: ``P = P_link + s t_hat``, s at the point's time.

    Parameters
    ----------
    profiles : Profiles
    model : RangeModel
    stage_position_mm : array_like of float64, shape (len(profiles),) or scalar
        Stage position at ``profiles.t_us``. Points whose position is NaN are left out.
    stage_direction : array_like of float64, shape (3,)
        Unit vector of the stage's motion.
    origin_us : int
        Sensor time that counts as ``t = 0``.

    Returns
    -------
    ndarray of POINT_DTYPE
        Or of REFLECTANCE_DTYPE, as from :func:`place_link`.

    Raises
    ------
    ArgumentError
        When the positions do not match the points, the direction is not a unit vector, or the
        profiles or the model are none.
    """
    if not isinstance(profiles, Profiles):
        raise ArgumentError(f"profiles is {short(profiles)}; give the Profiles of a Reconstructor")
    if not isinstance(model, RangeModel):
        raise ArgumentError(f"model is {short(model)}; give the model of a Reconstructor")
    position = _positions("stage_position_mm", stage_position_mm, len(profiles))
    known = np.isfinite(position)
    if not known.all():
        profiles = profiles.select(known)
        position = position[known]
    points = place_link(profiles, model, origin_us)
    add_stage(points, position, stage_direction)
    return points


def add_stage(points: NDArray[np.void], position_mm: ArrayLike, stage_direction: ArrayLike) -> None:
    """Move ``points`` in place by ``s t_hat``: ``P = P_link + s t_hat``.

    - ``points``: POINT_DTYPE or REFLECTANCE_DTYPE, shape (n,).
    - ``position_mm``: Shape (n,), or a scalar for all points.
    - ``stage_direction``: Unit vector, shape (3,).

    Raises ``ArgumentError`` when the positions do not match the points or the direction is not a
    unit vector.
    """
    position = _positions("position_mm", position_mm, len(points))
    for axis, part in zip("xyz", _unit(stage_direction), strict=True):
        if part:
            points[axis] += part * position * 1e-3


def _positions(name: str, position_mm: ArrayLike, points: int) -> NDArray[np.float64]:
    """Return one position for each point."""
    position = reals(name, position_mm)
    if not position.ndim:
        return np.full(points, position)
    if position.shape != (points,):
        raise ArgumentError(
            f"{name} has shape {position.shape}; give one position for each of the {points} points"
        )
    return position


def stage_offset_m(position_mm: ArrayLike, stage_direction: ArrayLike) -> NDArray[np.float64]:
    """Return ``s t_hat`` in metres, x, y and z along the first axis.

    Raises ``ArgumentError`` when the direction is not a unit vector.
    """
    direction = _unit(stage_direction)
    return np.multiply.outer(direction, reals("position_mm", position_mm)) * 1e-3


def _unit(stage_direction: ArrayLike) -> NDArray[np.float64]:
    direction = vector("stage_direction", stage_direction)
    if direction.shape != (3,) or not abs(float(direction @ direction) - 1.0) < 1e-6:
        raise ArgumentError(f"stage_direction is {stage_direction!r}; give a unit vector x, y, z")
    return direction
