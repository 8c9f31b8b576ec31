"""A face: smooth, with nose bridge, eye sockets, lips and ears, as a height field.

Every ray ends at the first surface it meets, which the camera sees unless an effect hides it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes.scene import RecentRays, sheet

HEAD_HALF_WIDTH_MM = 72.0
HEAD_HALF_HEIGHT_MM = 112.0
HEAD_DEPTH_MM = 78.0
EAR_OFF_MM = 76.0
EAR_DEPTH_MM = 92.0
_EAR_HALF_MM = (13.0, 31.0)
_EAR_END_MM = EAR_OFF_MM + _EAR_HALF_MM[0]
_EAR_LINE_MM = 2.0
_SKIN, _LIPS, _EYES = 0.75, 0.5, 0.9
_SOLVE_STEPS = 4
_BELL_END = 1e-9
"""Parts of a bump below this share of its height are left out: less than 20 pm."""

# Bumps: across and up from the middle of the face, their half widths, and the height; mm. Those off
# the middle come in pairs. Up is +z.
_BUMPS = (
    (0.0, -12.0, 10.0, 11.0, 17.0),  # nose tip
    (0.0, 8.0, 7.0, 20.0, 9.0),  # nose bridge
    (10.0, -16.0, 6.0, 6.0, 7.0),  # nostrils
    (29.0, 22.0, 16.0, 10.0, -13.0),  # eye sockets
    (30.0, 21.0, 9.0, 6.0, 7.0),  # eyeballs
    (24.0, 40.0, 20.0, 8.0, 5.0),  # brows
    (42.0, -8.0, 17.0, 14.0, 7.0),  # cheekbones
    (0.0, -43.0, 19.0, 4.5, 6.0),  # upper lip
    (0.0, -53.0, 16.0, 5.0, 6.5),  # lower lip
    (0.0, -48.0, 22.0, 1.8, -4.0),  # mouth
    (0.0, -63.0, 18.0, 5.0, -4.0),  # under the lip
    (0.0, -83.0, 18.0, 13.0, 12.0),  # chin
)

_Height = Callable[[Array], tuple[Array, NDArray[np.bool_]]]
"""Height over the front of the face, of places ``up`` along the line, and a mask of the surface."""


@dataclass(frozen=True)
class Face:
    """A face towards the sensor, upright along the laser line, nothing behind it.

    Raises ``ArgumentError`` when ``centre_mm`` is not positive.
    """

    centre_mm: float = 1000.0
    """Range of the head's front before nose and chin, which are nearer."""
    centre_stage_mm: float = 100.0
    """Stage position of the nose; the ears are 90 mm to either side."""
    _recent: RecentRays = field(init=False, repr=False, compare=False, default_factory=RecentRays)

    def __post_init__(self) -> None:
        if not self.centre_mm > 0.0:
            raise ArgumentError(f"centre_mm is {self.centre_mm!r}; choose a positive range")

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`; NaN beside the face."""
        return self._recent.get(self._meet, stage_mm, columns, model)[0]

    def reflectance(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the reflectance of skin, darker lips and lighter eyes; 0 beside the face."""
        x, z = self._recent.get(self._meet, stage_mm, columns, model)
        y, _ = sheet(stage_mm, columns, model)
        across = y - self.centre_stage_mm
        up = np.where(np.isnan(x), 0.0, z)
        lips = _bell(across, 0.0, 18.0) * _bell(up, -48.0, 7.0)
        eyes = _bell(np.abs(across), 30.0, 7.0) * _bell(up, 21.0, 4.0)
        albedo = _SKIN + (_LIPS - _SKIN) * lips + (_EYES - _SKIN) * eyes
        return np.where(np.isnan(x), 0.0, albedo)

    def _meet(
        self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel
    ) -> tuple[Array, Array]:
        """Return range and height at which each ray meets head or ear; NaN for neither."""
        y, slope = sheet(stage_mm, columns, model)
        across, depth_mm = y - self.centre_stage_mm, self.centre_mm + model.b_mm
        x = np.full((y.size, slope.size), np.nan)
        up = x.copy()
        for height, columns_of, rows_of in (
            (_head_mm, HEAD_HALF_HEIGHT_MM, (0.0, HEAD_HALF_WIDTH_MM)),
            (_ear_mm, _EAR_LINE_MM + _EAR_HALF_MM[1], (EAR_OFF_MM - _EAR_HALF_MM[0], _EAR_END_MM)),
        ):
            aside = np.abs(across[:, 0])
            rows = np.flatnonzero((aside >= rows_of[0]) & (aside <= rows_of[1]))
            # A hit is behind the front, so further from the axis than the ray at the front.
            cols = np.flatnonzero(np.abs(slope[0]) * depth_mm <= columns_of)
            if rows.size == 0 or cols.size == 0:
                continue
            part = np.ix_(rows, cols)
            found, found_up = _solve(rows.size, slope[:, cols], depth_mm, height(across[rows]))
            nearer = ~(x[part] <= found - model.b_mm) & ~np.isnan(found)
            x[part] = np.where(nearer, found - model.b_mm, x[part])
            up[part] = np.where(nearer, found_up, up[part])
        return x, up


def _bell(at: Array, centre: float, half_width: float) -> Array:
    return np.asarray(np.exp(-(((at - centre) / half_width) ** 2)))


def _head_mm(across: Array) -> _Height:
    """Return the height of the head towards the sensor."""
    bumps = []
    for off, line, half_across, half_up, bump in _BUMPS:
        sides = (off, -off) if off else (0.0,)
        bells = np.array(sum(_bell(across, side, half_across) for side in sides))
        bells[bells < _BELL_END] = 0.0
        if bells.any():
            bumps.append((bump * bells, line, half_up))

    def height_mm(up: Array) -> tuple[Array, NDArray[np.bool_]]:
        jaw = 1.0 - 0.22 / (1.0 + np.exp((up + 55.0) / 14.0))
        squared = (across / (HEAD_HALF_WIDTH_MM * jaw)) ** 2 + (up / HEAD_HALF_HEIGHT_MM) ** 2
        height = -HEAD_DEPTH_MM * np.minimum(squared, 1.5) ** 1.3
        for bump_mm, line, half_up in bumps:
            height += bump_mm * _bell(up, line, half_up)
        return height, squared <= 1.0

    return height_mm


def _ear_mm(across: Array) -> _Height:
    """Return the height of the ears, flat shells with a rim."""
    aside = np.abs(across) - EAR_OFF_MM

    def height_mm(up: Array) -> tuple[Array, NDArray[np.bool_]]:
        squared = (aside / _EAR_HALF_MM[0]) ** 2 + ((up - _EAR_LINE_MM) / _EAR_HALF_MM[1]) ** 2
        rim = 4.0 * np.exp(-(((squared - 0.75) / 0.25) ** 2))
        return rim - EAR_DEPTH_MM + 0.3 * np.clip(aside, -20.0, 20.0), squared <= 1.0

    return height_mm


def _solve(lines: int, slope: Array, depth_mm: float, height_mm: _Height) -> tuple[Array, Array]:
    """Return depth and height where ``x = depth - height(slope x)``, by secants.

    Rays are within 7 degrees of the x axis, so that ``x -> depth - height`` shrinks every error
    about fivefold even at the head's rim, and the secants leave less than 1 um.
    """
    before = np.broadcast_to(np.float64(depth_mm), (lines, slope.size))
    x = depth_mm - height_mm(slope * before)[0]
    change = x - before
    for _ in range(_SOLVE_STEPS - 2):
        new_change = depth_mm - height_mm(slope * x)[0] - x
        bend = change - new_change
        step = np.divide(new_change * (x - before), bend, out=new_change.copy(), where=bend != 0.0)
        before, change = x, new_change
        x = x + step
    up = slope * x
    final, there = height_mm(up)
    return np.where(there, depth_mm - final, np.nan), np.where(there, up, np.nan)
