"""A cloud that grows without bound, kept to a number of points that a browser can draw."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import integer
from eschorty_ros.surfaces.profiles import profile_begins

COLOURS = ("range", "sigma", "reflectance", "pass")
POINTS_MAX = 120_000
_ABSENT = 0.5
# Least correlation of position and time in a profile of a moving stage, squared.
_MOVING = 0.5


class Shown(NamedTuple):
    """Points to draw: places in m, values by name, received points, every how many-th is kept."""

    xyz: NDArray[np.float32]
    values: dict[str, NDArray[np.float32]]
    received: int
    stride: int


class GrowingCloud:
    """Keeps every n-th point; n doubles whenever the points would exceed the limit.

    - ``limit``: Points kept at most.
    """

    def __init__(self, limit: int = POINTS_MAX) -> None:
        self._limit = integer("limit", limit, 2, 100_000_000)
        self._lock = threading.Lock()
        self._kept = np.empty((limit, 3 + len(COLOURS)), np.float32)
        self.changes = 0
        self.clear()

    def clear(self) -> None:
        """Begin another cloud."""
        with self._lock:
            self._count = self._received = 0
            self._stride = 1
            self._pass, self._direction = 1, 0.0
            self.changes += 1

    def add(self, points: NDArray[np.void]) -> None:
        """Add points in m with ``x y z sigma``, and ``t column reflectance`` where known."""
        names = points.dtype.names or ()
        if not {"x", "y", "z", "sigma"} <= set(names):
            raise ArgumentError(f"points have the fields {' '.join(names)}; send x y z and sigma")
        with self._lock:
            self.changes += 1
            number = self._passes(points, names)
            begin = -self._received % self._stride
            self._received += len(points)
            while len(points):
                part = points[begin :: self._stride][: self._limit - self._count]
                self._store(part, number[begin :: self._stride][: len(part)], names)
                begin += len(part) * self._stride
                points, number = points[begin:], number[begin:]
                begin = 0
                if self._count == self._limit:
                    # Index i of the kept points is received point i times stride.
                    self._count = (self._limit + 1) // 2
                    self._kept[: self._count] = self._kept[::2][: self._count].copy()
                    missing = self._count * 2 * self._stride - (self._limit * self._stride)
                    self._stride *= 2
                    begin = missing

    def _store(
        self, part: NDArray[np.void], number: NDArray[np.float32], names: tuple[str, ...]
    ) -> None:
        rows = self._kept[self._count : self._count + len(part)]
        for k, name in enumerate(("x", "y", "z", "x", "sigma", "reflectance")):
            rows[:, k] = part[name] if name in names else np.nan
        rows[:, -1] = number
        self._count += len(part)

    def _passes(self, points: NDArray[np.void], names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return each point's pass: the stage turns before the next one."""
        if not {"t", "column"} <= set(names) or not len(points):
            return np.full(len(points), np.nan, np.float32)
        begins = profile_begins(points["column"])
        profile = np.repeat(np.arange(len(begins)), np.diff([*begins, len(points)]))
        t, y = (
            points[name].astype(np.float64) - points[name][begins][profile] for name in ("t", "y")
        )
        count, mean_t, mean_y = (np.bincount(profile, weights) for weights in (None, t, y))
        t -= (mean_t / count)[profile]
        y -= (mean_y / count)[profile]
        both = np.bincount(profile, t * y)
        spread = np.bincount(profile, t * t) * np.bincount(profile, y * y)
        number = np.empty(len(begins), np.float32)
        for k, direction in enumerate(np.where(both**2 > _MOVING * spread, np.sign(both), 0.0)):
            self._pass += int(direction * self._direction < 0.0)
            self._direction = direction or self._direction
            number[k] = self._pass
        return number[profile]

    def shown(self) -> Shown:
        """Return what to draw now; points that are not finite are left out."""
        with self._lock:
            kept, received, stride = self._kept[: self._count].copy(), self._received, self._stride
        kept = kept[np.isfinite(kept[:, :3]).all(axis=1)]
        values = {name: kept[:, 3 + k] for k, name in enumerate(COLOURS)}
        return Shown(kept[:, :3], values, received, stride)


def colours(values: NDArray[np.float32]) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Return the colour of each value and the limits of the scale, the central 98 %."""
    from matplotlib import colormaps

    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (1.0, 99.0)) if len(known) else (0.0, 0.0)
    share = np.full(len(values), _ABSENT)
    if high > low:
        share = np.where(np.isnan(values), _ABSENT, (values - low) / (high - low)).clip(0.0, 1.0)
    table = (colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3] * 255).astype(np.uint8)
    return table[(share * 255).astype(np.uint8)], (float(low), float(high))
