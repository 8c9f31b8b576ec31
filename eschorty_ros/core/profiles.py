"""Profiles as the reconstruction hands them out, and their place in space."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core._checks import TIME_LIMIT, reals, selection, vector, whole
from eschorty_ros.core.cloud import POINT_DTYPE, REFLECTANCE_DTYPE
from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.optics import RangeModel

_DTYPES = {
    "period": np.int64,
    "edge_us": np.int64,
    "t_us": np.int64,
    "column": np.uint16,
    "row": np.float64,
    "sigma_row": np.float64,
    "range_mm": np.float64,
    "sigma_mm": np.float64,
    "events": np.uint32,
    "width_px": np.float64,
    "return_index": np.uint8,
}
_REFLECTANCE = ("reflectance", "reflectance_sigma")


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Points of whole profiles as arrays of equal length, by period, column, return index.

    Attributes
    ----------
    period : int64
        Index of the modulation period the point's profile begins with.
    edge_us : int64
        Rising edge that begins it, sensor time.
    t_us : int64
        Mean time of the events used, sensor time.
    column : uint16
    row, sigma_row : float64
        Row of the line and its standard deviation, px.
    range_mm, sigma_mm : float64
        Range along the sheet (Eq. 2) and its standard deviation.
    events : uint32
        Events used.
    width_px : float64
        Sample standard deviation of the rows used; 0 for a single event.
    return_index : uint8
        Place among the points of the same profile and column, nearest range first.
    reflectance, reflectance_sigma : float64, optional
        Relative reflectance and its standard deviation; ``None`` where nobody asked for it.
    """

    period: NDArray[np.int64]
    edge_us: NDArray[np.int64]
    t_us: NDArray[np.int64]
    column: NDArray[np.uint16]
    row: NDArray[np.float64]
    sigma_row: NDArray[np.float64]
    range_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]
    events: NDArray[np.uint32]
    width_px: NDArray[np.float64]
    return_index: NDArray[np.uint8]
    reflectance: NDArray[np.float64] | None = None
    reflectance_sigma: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.column)

    @classmethod
    def empty(cls) -> Profiles:
        """No points."""
        return cls(**{name: np.empty(0, dtype) for name, dtype in _DTYPES.items()})

    @classmethod
    def concatenate(cls, parts: Iterable[Profiles]) -> Profiles:
        """All points of ``parts`` in their order; NaN for a reflectance only some parts have."""
        kept = [part for part in parts if len(part)]
        if not kept:
            return cls.empty()
        names = list(_DTYPES)
        if any(part.reflectance is not None for part in kept):
            names += _REFLECTANCE
            kept = [part if part.reflectance is not None else part._unknown() for part in kept]
        return cls(
            **{name: np.concatenate([getattr(part, name) for part in kept]) for name in names}
        )

    def select(self, mask: ArrayLike | slice) -> Profiles:
        """Pick points by a boolean mask, a slice or an index array."""
        picked = mask if isinstance(mask, slice) else selection("mask", mask, len(self))
        chosen: dict[str, Any] = {item.name: getattr(self, item.name) for item in fields(self)}
        for name, values in chosen.items():
            chosen[name] = None if values is None else values[picked]
        return Profiles(**chosen)

    def _unknown(self) -> Profiles:
        """Give the points a reflectance of NaN."""
        nothing = np.full(len(self), np.nan)
        return replace(self, reflectance=nothing, reflectance_sigma=nothing)

    @property
    def profile_count(self) -> int:
        """Number of different profiles."""
        return int(np.count_nonzero(np.diff(self.edge_us))) + 1 if len(self) else 0


def place_link(profiles: Profiles, model: RangeModel, origin_us: int = 0) -> NDArray[np.void]:
    """Points in the moving frame ``eschorty_link``: x = range, z along the line, y = 0.

    Parameters
    ----------
    profiles : Profiles
    model : RangeModel
    origin_us : int
        Sensor time that counts as ``t = 0``, subtracted before the conversion to float.

    Returns
    -------
    ndarray of POINT_DTYPE, shape (len(profiles),)
        Metres and seconds; ``sigma`` is the range's standard deviation. Of REFLECTANCE_DTYPE where
        the profiles know their reflectance.
    """
    known = profiles.reflectance is not None
    whole("origin_us", origin_us, -TIME_LIMIT, TIME_LIMIT)
    points = np.zeros(len(profiles), dtype=REFLECTANCE_DTYPE if known else POINT_DTYPE)
    points["x"] = profiles.range_mm * 1e-3
    points["z"] = model.lateral_mm(profiles.column, profiles.range_mm) * 1e-3
    points["intensity"] = profiles.events
    points["sigma"] = profiles.sigma_mm * 1e-3
    points["t"] = (profiles.t_us - np.int64(origin_us)) * 1e-6
    points["column"] = profiles.column
    if known:
        points["reflectance"] = profiles.reflectance
        points["reflectance_sigma"] = profiles.reflectance_sigma
    return points


def place(
    profiles: Profiles,
    model: RangeModel,
    stage_position_mm: ArrayLike,
    stage_direction: ArrayLike,
    origin_us: int = 0,
) -> NDArray[np.void]:
    """Points in ``eschorty_base``: ``P = P_link + s t_hat``, s at the mean time of the events used.

    Parameters
    ----------
    profiles : Profiles
    model : RangeModel
    stage_position_mm : array_like of float64, shape (len(profiles),) or scalar
        Stage position at ``profiles.t_us``. Points whose position is NaN are left out; the
        difference in length is theirs to count by the caller.
    stage_direction : array_like of float64, shape (3,)
        Unit vector of the stage's motion.
    origin_us : int
        Sensor time that counts as ``t = 0``.

    Returns
    -------
    ndarray of POINT_DTYPE
        Or of REFLECTANCE_DTYPE, as :func:`place_link` gives them.

    Raises
    ------
    ArgumentError
        When the positions do not match the points or the direction is not a unit vector.
    """
    position = reals("stage_position_mm", stage_position_mm)
    if position.ndim and position.shape != (len(profiles),):
        raise ArgumentError(
            f"stage_position_mm has shape {position.shape}; give one position for each of the "
            f"{len(profiles)} points"
        )
    direction = vector("stage_direction", stage_direction)
    if direction.shape != (3,) or not abs(float(direction @ direction) - 1.0) < 1e-6:
        raise ArgumentError(f"stage_direction is {stage_direction!r}; give a unit vector x, y, z")
    position = np.broadcast_to(position, (len(profiles),))
    known = np.isfinite(position)
    if not known.all():
        profiles = profiles.select(known)
        position = position[known]
    points = place_link(profiles, model, origin_us)
    lateral_mm = model.lateral_mm(profiles.column, profiles.range_mm)
    points["x"] = (profiles.range_mm + position * direction[0]) * 1e-3
    points["y"] = position * direction[1] * 1e-3
    points["z"] = (lateral_mm + position * direction[2]) * 1e-3
    return points
