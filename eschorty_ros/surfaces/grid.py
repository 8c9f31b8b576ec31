"""A cloud as a grid of modulation periods and columns, and where its surface is interrupted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import positive
from eschorty_ros.core.storage.cloud import MIXED, SENSOR_EDGE
from eschorty_ros.surfaces.profiles import period_s, profile_index

CELLS_MAX = 50_000_000
STEP_SIGMAS = 5.0
"""Of medians: neighbours share most of their points, so that this is a large difference."""
# Smoothing, narrow at a step, spreads it over up to 4 differences: the median of 9 ignores it.
_SLOPE_WINDOW = 9
_LINES_AT_ONCE = 256


class CloudGrid(NamedTuple):
    """A cloud as an image, one line per modulation period; a cell without a point holds NaN."""

    point: NDArray[np.int64]
    """Shape (lines, columns). Place of the cell's point in the cloud, -1 for none; of several the
    one of most events."""
    first_column: int
    """Column of the image's first one."""
    xyz: Array
    """Shape (lines, columns, 3), mm."""
    sigma: Array
    """Shape (lines, columns), mm."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Return where a cell has a point."""
        return self.point >= 0


class Links(NamedTuple):
    """Neighbours that are on one surface: along, (lines - 1, columns); across, one column less."""

    along: NDArray[np.bool_]
    across: NDArray[np.bool_]


def organise(points: NDArray[np.void]) -> CloudGrid:
    """Return a cloud as a grid.

    Left out are points without finite place, time or positive sigma, and those flagged as on two
    surfaces or cut by the sensor's edge.

    - ``points``: POINT_DTYPE, shape (n,).

    Raises ``ArgumentError`` when no two periods have a point, or the grid would be too large.
    """
    whole = _on_one_surface(points)
    kept = np.flatnonzero(
        np.all([np.abs(points[axis]) < 1e6 for axis in "xyz"], axis=0)
        & (np.abs(points["t"]) < 1e9)
        & (points["sigma"] > 0.0)
        & (points["sigma"] < 1e6)
        & whole
    )
    chosen = points[kept]
    period = period_s(chosen) if len(chosen) else float("nan")
    if not period > 0.0:
        raise ArgumentError(
            f"the cloud has {len(chosen):,} points with place, time and sigma in fewer than two "
            f"modulation periods, {np.count_nonzero(~whole):,} more with the flag mixed or "
            "sensor_edge; give a cloud of a sweep"
        )
    line = profile_index(chosen, period)
    first = int(chosen["column"].min())
    shape = int(line.max()) + 1, int(chosen["column"].max()) - first + 1
    if shape[0] * shape[1] > CELLS_MAX:
        raise ArgumentError(
            f"the cloud spans {shape[0]:,} periods of {shape[1]:,} columns; give a part of at most "
            f"{CELLS_MAX:,} cells"
        )
    index = np.full(shape, -1, np.int64)
    order = np.argsort(chosen["intensity"], kind="stable")
    index[line[order], chosen["column"][order].astype(np.int64) - first] = kept[order]
    known = index >= 0
    xyz, sigma = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    for k, axis in enumerate("xyz"):
        xyz[known, k] = points[axis][index[known]].astype(np.float64) * 1e3
    sigma[known] = points["sigma"][index[known]].astype(np.float64) * 1e3
    return CloudGrid(index, first, xyz, sigma)


def _on_one_surface(points: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which points have neither of these flags; those without flags all pass."""
    if "flags" not in (points.dtype.names or ()):
        return np.ones(len(points), bool)
    return np.asarray(points["flags"] & (MIXED | SENSOR_EDGE) == 0)


def links(grid: CloudGrid, sigmas: float, steepness: float = 0.0) -> Links:
    """Return which neighbours are on one surface.

    The range between two neighbours may differ from the local slope by ``sigmas`` standard
    deviations of the difference, or by ``steepness`` times their distance across. The slope is the
    median of the differences around, which a single step does not change.
    """
    positive("sigmas", sigmas)
    range_mm, y, z = np.moveaxis(grid.xyz, -1, 0)
    variance = grid.sigma**2
    return Links(
        _joined(range_mm, variance, y * steepness, sigmas),
        _joined(range_mm.T, variance.T, z.T * steepness, sigmas).T,
    )


def _joined(range_mm: Array, variance: Array, steep: Array, sigmas: float) -> NDArray[np.bool_]:
    """Return which cells continue in the next line; ``steep`` is a surface of the largest slope."""
    step = np.diff(range_mm, axis=0)
    limit = np.maximum(
        sigmas * np.sqrt(variance[1:] + variance[:-1]), np.abs(np.diff(steep, axis=0))
    )
    with np.errstate(invalid="ignore"):
        return np.abs(step - _slopes(step)) <= limit


def _slopes(step: Array) -> Array:
    """Return the median of the known values within the window along the first axis."""
    half = _SLOPE_WINDOW // 2
    padded = np.pad(step, ((half, half), (0, 0)), constant_values=np.nan)
    slopes = np.empty_like(step)
    for begin in range(0, len(step), _LINES_AT_ONCE):
        part = padded[begin : begin + _LINES_AT_ONCE + 2 * half]
        windows = np.lib.stride_tricks.sliding_window_view(part, _SLOPE_WINDOW, axis=0)
        slopes[begin : begin + _LINES_AT_ONCE] = _median(windows)
    return slopes


def _median(values: Array) -> Array:
    """Return the median of the known values along the last axis, NaN for none."""
    # NaN is sorted to the end.
    ordered = np.sort(values, axis=-1)
    count = np.count_nonzero(ordered == ordered, axis=-1)[..., None]
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    middle = np.take_along_axis(ordered, low, -1) + np.take_along_axis(ordered, high, -1)
    return np.asarray(0.5 * middle[..., 0])


def smoothed(grid: CloudGrid, half: int) -> CloudGrid:
    """Return a grid with the median range of ``2 half + 1`` lines and columns, its sigma reduced.

    The median is that of the differences from the local slope: on steep surfaces the range itself
    would be that of the middle line alone, and at rims that of a place beside. The sigma is that
    of a median of independent Gaussian errors.
    """
    known = grid.known
    values = np.where(known, grid.xyz[..., 0], np.nan)
    down, across = (_tilts(values, axis) for axis in (0, 1))
    size = 2 * half + 1
    places = np.arange(-half, half + 1.0)
    padded = np.pad(values, half, constant_values=np.nan)
    xyz, sigma = grid.xyz.copy(), grid.sigma.copy()
    for begin in range(0, len(values), _LINES_AT_ONCE):
        rows = slice(begin, begin + _LINES_AT_ONCE)
        part = padded[begin : begin + _LINES_AT_ONCE + 2 * half]
        level = np.lib.stride_tricks.sliding_window_view(part, (size, size))
        level = level - down[rows, :, None, None] * places[:, None]
        level -= across[rows, :, None, None] * places
        level = level.reshape(*level.shape[:2], size * size)
        xyz[rows, :, 0] = np.where(known[rows], _median(level), np.nan)
        count = np.count_nonzero(level == level, axis=-1)
        sigma[rows] *= np.sqrt(np.pi / 2.0 / np.maximum(count, 1))
    return grid._replace(xyz=xyz, sigma=sigma)


def _tilts(values: Array, axis: int) -> Array:
    """Return the local slope of every cell along an axis, mm per cell; 0 where none is known."""
    along = np.moveaxis(values, axis, 0)
    tilts = np.zeros_like(along)
    if len(along) > 1:
        # Medians along and then across, as differences of two points are noisy.
        tilts[:-1] = np.nan_to_num(_slopes(_slopes(np.diff(along, axis=0)).T).T)
        tilts[-1] = tilts[-2]
    return np.moveaxis(tilts, 0, axis)
