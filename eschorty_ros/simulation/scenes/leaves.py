"""A collage of leaves: three layers that overlap, with leaves 2.2 mm apart within a layer.

Every ray ends at the first leaf it meets, which the camera sees unless an effect hides it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes.scene import RecentRays, sheet

SEPARATION_MM = 2.2
"""Between neighbouring levels of a layer: the paper's leaves at 1.32 m (Fig. 8)."""

LEVELS = 3
_PETIOLE_SHARE = 0.28
_PETIOLE_HALF_MM = 1.6
_MIDRIB_MM, _MIDRIB_HALF_MM = 0.6, 1.8
_VEIN_MM, _VEIN_HALF_MM, _VEIN_EVERY_MM = 0.35, 0.9, 10.0
_VEIN_LEAN = 0.9
_SOLVE_STEPS = 2
_CENTRE_STAGE_MM = 100.0
_LAYER_STAGE_MM = (145.0, 95.0, 52.0)
_STAGE_WAVE_MM = 12.0
_LINE_TRAVEL_MM = 122.0


Value = float | Array


@dataclass(frozen=True, slots=True)
class Leaf:
    """One leaf, or as arrays the leaf of each ray: position of its blade, its heading and shape."""

    depth_mm: Value
    """Range of its level before the layer's curvature is added."""
    stage_mm: Value
    line_mm: Value
    """Middle of the blade."""
    heading_stage: Value
    heading_line: Value
    """Unit vector from stalk to tip."""
    length_mm: Value
    half_width_mm: Value
    """Of the blade; the petiole adds a quarter to the length."""
    fullness: Value
    """Below 1 the blade is widest near the stalk."""
    lobes: Value
    lobe_depth: Value
    """Number of lobes on either side and the depth of their cuts, 0 to 1."""
    albedo: Value

    @property
    def half_extent_mm(self) -> tuple[Array, Array]:
        """Return half of the box around blade and petiole: along the stage and along the line."""
        along = self.length_mm * (0.5 + _PETIOLE_SHARE)
        s, c = np.abs(self.heading_stage), np.abs(self.heading_line)
        return along * s + self.half_width_mm * c, along * c + self.half_width_mm * s

    def take(self, index: NDArray[Any]) -> Leaf:
        """Return the leaf of every entry of ``index``, from leaves as arrays."""
        return Leaf(*(np.asarray(getattr(self, name))[index] for name in self.__slots__))

    def place(self, y: Array, z: Array) -> tuple[Array, Array]:
        """Return coordinates in the leaf, mm: from its stalk to its tip, and across."""
        dy, dz = y - self.stage_mm, z - self.line_mm
        along = dz * self.heading_line + dy * self.heading_stage + 0.5 * self.length_mm
        return along, dy * self.heading_line - dz * self.heading_stage

    def near(self, along: Array, across: Array) -> NDArray[np.bool_]:
        """Return a mask of points within the box around blade and petiole, 1 mm beside included."""
        within = (along > -_PETIOLE_SHARE * self.length_mm - 1.0) & (along < self.length_mm + 1.0)
        return np.asarray(within & (np.abs(across) < self.half_width_mm + 1.0))

    def covers(self, along: Array, across: Array) -> NDArray[np.bool_]:
        """Return a mask of points on blade or petiole."""
        distance = np.abs(across)
        u = np.clip(along / self.length_mm, 0.0, 1.0)
        # Lobes lean towards the tip as the side veins do.
        turns = self.lobes * (u - 0.5 * distance / self.length_mm)
        cut = self.lobe_depth * (0.5 + 0.5 * np.cos(2.0 * np.pi * turns))
        half = self.half_width_mm * np.sin(np.pi * u**self.fullness) * (1.0 - cut)
        petiole = (along > -_PETIOLE_SHARE * self.length_mm) & (along <= 0.25 * self.length_mm)
        return np.asarray((distance < half) | (petiole & (distance < _PETIOLE_HALF_MM)))

    def vein_mm(self, along: Array, across: Array) -> Array:
        """Return the height of midrib and side veins above the blade."""
        distance = np.abs(across)
        midrib = np.maximum(1.0 - distance / _MIDRIB_HALF_MM, 0.0)
        phase = (along - _VEIN_LEAN * distance) / _VEIN_EVERY_MM
        off = np.abs(phase - np.rint(phase)) * _VEIN_EVERY_MM
        side = np.maximum(1.0 - off / _VEIN_HALF_MM, 0.0)
        return np.maximum(_MIDRIB_MM * midrib, _VEIN_MM * side)


@dataclass(frozen=True)
class Leaves:
    """Three layers of leaves in front of nothing, 200 mm along the stage, 330 mm along the line.

    Leaves of one layer share its curvature, so that two of them that overlap are exactly
    ``SEPARATION_MM`` (or twice that) apart; veins stand out by up to 0.6 mm.

    Raises ``ArgumentError`` when a number is not positive.
    """

    centre_mm: float = 1320.0
    """Range of the middle layer's first level."""
    span_mm: float = 210.0
    """From the nearest to the farthest layer."""
    leaves_per_layer: int = 7
    seed: int = 8
    """Fixes every leaf's place, shape and reflectance."""
    leaves: tuple[Leaf, ...] = field(init=False, repr=False)
    _arrays: Leaf = field(init=False, repr=False, compare=False)
    _recent: RecentRays = field(init=False, repr=False, compare=False, default_factory=RecentRays)

    def __post_init__(self) -> None:
        for name in ("centre_mm", "span_mm", "leaves_per_layer"):
            if not getattr(self, name) > 0:
                raise ArgumentError(f"{name} is {getattr(self, name)!r}; choose a positive value")
        rng = np.random.default_rng(self.seed)
        # The farthest leaf is the last level of the last layer.
        half_mm = 0.5 * (self.span_mm - (LEVELS - 1) * SEPARATION_MM)
        layers = (self.centre_mm - half_mm, self.centre_mm, self.centre_mm + half_mm)
        leaves = [
            leaf
            for depth, stage in zip(layers, _LAYER_STAGE_MM, strict=True)
            for leaf in self._layer(depth, stage, rng)
        ]
        object.__setattr__(self, "leaves", tuple(leaves))
        arrays = Leaf(*(np.array([getattr(x, name) for x in leaves]) for name in Leaf.__slots__))
        object.__setattr__(self, "_arrays", arrays)

    def _layer(self, depth_mm: float, stage_mm: float, rng: np.random.Generator) -> list[Leaf]:
        """Return leaves along a wavy row, each overlapping the one before, level after level."""
        count = self.leaves_per_layer
        line = np.linspace(-_LINE_TRAVEL_MM, _LINE_TRAVEL_MM, count) + rng.uniform(-8, 8, count)
        wave = np.sin(rng.uniform(0.0, 2.0 * np.pi) + 2.4 * np.arange(count))
        stage = stage_mm + _STAGE_WAVE_MM * wave
        angle = rng.uniform(-1.3, 1.3, count) + np.pi * rng.integers(0, 2, count)
        return [
            Leaf(
                depth_mm=depth_mm + SEPARATION_MM * (k % LEVELS),
                stage_mm=float(stage[k]),
                line_mm=float(line[k]),
                heading_stage=float(np.sin(angle[k])),
                heading_line=float(np.cos(angle[k])),
                length_mm=float(rng.uniform(66.0, 90.0)),
                half_width_mm=float(rng.uniform(18.0, 25.0)),
                fullness=float(rng.uniform(0.7, 0.9)),
                lobes=float(rng.integers(4, 6)),
                lobe_depth=float(rng.choice([0.0, 0.45])),
                albedo=float(rng.uniform(0.5, 0.95)),
            )
            for k in range(count)
        ]

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`; NaN between the leaves."""
        return self._hits(stage_mm, columns, model)[0]

    def reflectance(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return each leaf's reflectance, 0 between the leaves."""
        leaf = self._hits(stage_mm, columns, model)[1]
        return np.append(self._arrays.albedo, 0.0)[leaf]

    def leaf_index(
        self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel
    ) -> NDArray[np.intp]:
        """Return the index in ``leaves`` of every ray's hit, -1 for none; shape (n, m)."""
        return self._hits(stage_mm, columns, model)[1]

    def curvature_mm(self, stage_mm: ArrayLike, line_mm: ArrayLike) -> Array:
        """Return the leaves' deviation from their level, mm; the arguments broadcast."""
        y = (np.asarray(stage_mm, dtype=np.float64) - _CENTRE_STAGE_MM) / 100.0
        z = np.asarray(line_mm, dtype=np.float64) / 165.0
        return np.asarray(1.5 * y * y + 1.5 * z * z + 1.5 * y * z - 1.0)

    def _hits(
        self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel
    ) -> tuple[Array, NDArray[np.intp]]:
        return self._recent.get(self._cast, stage_mm, columns, model)

    def _cast(
        self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return range and leaf of the first hit of every ray: NaN and -1 for none."""
        y, slope = sheet(stage_mm, columns, model)
        every = self._arrays
        tall, wide = every.half_extent_mm
        rows = np.abs(y - every.stage_mm) < tall
        line = slope.T * (every.depth_mm + model.b_mm)
        # Curvature moves a hit along the line by less than 1 mm.
        cols = np.abs(line - every.line_mm) < wide + 1.0
        row, col, which = np.nonzero(rows[:, np.newaxis, :] & cols[np.newaxis, :, :])
        leaf, at, z = every.take(which), y[row, 0], line[col, which]
        close = leaf.near(*leaf.place(at, z))
        row, col, which, at, z = row[close], col[close], which[close], at[close], z[close]
        x, inside = self._meet(every.take(which), at, z, slope[0, col], model.b_mm)
        place, x, which = (row * slope.size + col)[inside], x[inside], which[inside]
        near = np.full(y.size * slope.size, np.inf)
        np.minimum.at(near, place, x)
        hit = np.full(near.size, -1, dtype=np.intp)
        first = x == near[place]
        hit[place[first]] = which[first]
        shape = (y.size, slope.size)
        return np.where(hit < 0, np.nan, near).reshape(shape), hit.reshape(shape)

    def _meet(
        self, leaf: Leaf, y: Array, z: Array, slope: Array, b_mm: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the range at which each ray meets its leaf's surface, and a mask of real hits.

        The surface is nearly flat: a step of ``x = surface(y, slope (x + b))`` reduces the error to
        less than a twentieth, and two of them to less than 2 um.
        """
        x = leaf.depth_mm + self.curvature_mm(y, z)
        for _ in range(_SOLVE_STEPS):
            z = slope * (x + b_mm)
            along, across = leaf.place(y, z)
            x = leaf.depth_mm + self.curvature_mm(y, z) - leaf.vein_mm(along, across)
        return x, leaf.covers(along, across)
