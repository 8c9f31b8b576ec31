"""Planes through parts of a grid, with the covariance that the scatter and the own sigmas show.

Neighbouring points share errors: smoothing over columns, the pattern of the pixels, the phase of a
period. The covariance is clustered by strips of columns, by strips of lines and by both (Cameron,
Gelbach and Miller, "Robust inference with multiway clustering", J. Bus. Econ. Stat. 29, 2011), and
nowhere below that of one kind of strips or that of independent errors of the points' own sigmas.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import SIGMA_PER_MAD
from eschorty_ros.surfaces.grid import CloudGrid

POINTS_MIN = 30
_EXTENT_MIN_MM = 0.01
COMMON_SHARE = 0.16
"""Mean error of simulated planes that face the sensor, as a share of the points' own sigma."""
CUT_SIGMA = 4.0
_SURE_SIGMAS = 3.0
_ITERATIONS = 20
# Errors of columns closer than 17, which smoothing averages at most by default, and of lines closer
# than 4 are alike; fewer than 4 strips show no scatter.
_STRIP_COLUMNS, _STRIP_LINES = 24, 6
_STRIPS = 4, 16
_FLAT_CELLS = 8


class Value(NamedTuple):
    """A measured value and its standard deviation."""

    value: float
    sigma: float


class Part(NamedTuple):
    """Points of a grid: line, column, x y z in mm as (n, 3), sigma in mm."""

    line: NDArray[np.int64]
    column: NDArray[np.int64]
    xyz: Array
    sigma: Array

    @classmethod
    def of(cls, grid: CloudGrid, mask: NDArray[np.bool_]) -> Part:
        """Return the points of the cells in a mask."""
        line, column = np.nonzero(mask & grid.known)
        return cls(line, column, grid.xyz[line, column], grid.sigma[line, column])

    def select(self, which: NDArray[np.bool_] | slice) -> Part:
        """Return the points of a mask or slice."""
        return Part(self.line[which], self.column[which], self.xyz[which], self.sigma[which])


class Plane(NamedTuple):
    """The plane ``x = centre[0] + slope_y (y - centre[1]) + slope_z (z - centre[2])``, mm."""

    centre: Array
    """Shape (3,)."""
    slopes: Array
    """Shape (2,). mm of range per mm of y and of z."""
    covariance: Array
    """Shape (3, 3). Of the range at the centre and of both slopes."""
    residual: Array
    """Shape (n,). Measured minus fitted range, mm."""
    kept: NDArray[np.bool_]
    """Shape (n,). Points of the fit; the others are beyond 4 robust sigma."""

    @property
    def cosine(self) -> float:
        """Cosine between range and normal: a distance along x times it is along the normal."""
        return float(1.0 / np.sqrt(1.0 + self.slopes @ self.slopes))

    @property
    def normal(self) -> Array:
        """Unit normal, away from the sensor."""
        return np.array([1.0, *-self.slopes]) * self.cosine

    @property
    def rms_mm(self) -> float:
        """Root mean square of the kept residuals."""
        return float(np.sqrt(np.mean(self.residual[self.kept] ** 2)))

    def slope(self, axis: int) -> Value:
        """Return the slope along y (0) or z (1)."""
        return Value(float(self.slopes[axis]), float(np.sqrt(self.covariance[axis + 1, axis + 1])))

    def range_at(self, y: float, z: float) -> Value:
        """Return the range at a place, mm."""
        row = np.array([1.0, y - self.centre[1], z - self.centre[2]])
        value = self.centre[0] + self.slopes @ row[1:]
        return Value(float(value), float(np.sqrt(row @ self.covariance @ row)))


class Flatness(NamedTuple):
    """Peak to valley of the mean residual in cells, along the normal, mm.

    ``of_plane_mm`` is what a perfect plane shows at this noise.
    """

    value_mm: Value
    of_plane_mm: float

    @property
    def of_no_plane(self) -> bool:
        """Return whether it is above that of a perfect plane by more than its error explains."""
        return self.value_mm.value - self.of_plane_mm > _SURE_SIGMAS * self.value_mm.sigma


def fit_plane(part: Part, common_mm: float) -> Plane:
    """Return the weighted least-squares plane of range over y and z, outliers left out.

    ``common_mm`` is the standard deviation of an error that the points share; from one end of the
    part to the other it differs by as much. `check_part` refuses too few points.
    """
    middle = np.median(part.xyz[:, 1:], axis=0)
    design = np.column_stack([np.ones(len(part.line)), part.xyz[:, 1:] - middle])
    fit = solve(design, part)
    extent = extent_mm(part.xyz[:, 1:])
    covariance = fit.covariance + np.diag((common_mm / np.array([1.0, *extent])) ** 2)
    centre = np.array([fit.values[0], *middle])
    return Plane(centre, fit.values[1:], covariance, fit.residual, fit.kept)


def extent_mm(places: Array) -> Array:
    """Return the extent of points along each axis, which a stray one does not widen."""
    low, high = np.quantile(places, (0.01, 0.99), axis=0)
    return np.asarray((high - low) / 0.98)


class Fit(NamedTuple):
    """Values of a linear model with their covariance, and the residuals and use of its points."""

    values: Array
    covariance: Array
    residual: Array
    kept: NDArray[np.bool_]


def solve(design: Array, part: Part) -> Fit:
    """Return the weighted least-squares fit of a linear model of the range, outliers left out."""
    kept = np.ones(len(part.line), bool)
    for _ in range(_ITERATIONS):
        root = 1.0 / part.sigma[kept]
        values = np.linalg.lstsq(
            design[kept] * root[:, None], part.xyz[kept, 0] * root, rcond=None
        )[0]
        residual = part.xyz[:, 0] - design @ values
        ratio = residual / part.sigma
        scale = max(SIGMA_PER_MAD * float(np.median(np.abs(ratio[kept]))), 1.0)
        before, kept = kept, np.abs(ratio) <= CUT_SIGMA * scale
        if np.array_equal(kept, before):
            break
    covariance = clustered_covariance(design[kept], residual[kept], part.select(kept))
    return Fit(values, covariance, residual, kept)


def clustered_covariance(design: Array, residual: Array, part: Part) -> Array:
    """Return the covariance of a weighted least-squares fit whose neighbours share errors.

    - ``design``: Shape (n, values).
    - ``residual``: Shape (n,).
    - ``part``: Line, column and sigma of each residual.
    """
    weight = 1.0 / part.sigma**2
    own = np.linalg.inv(design.T @ (design * weight[:, None]))
    score = design * (weight * residual)[:, None]
    lines = _strips(part.line, _STRIP_LINES)
    columns = _strips(part.column, _STRIP_COLUMNS)
    both = lines * (int(columns.max()) + 1) + columns
    down, aside = _spread(score, lines), _spread(score, columns)
    root = np.linalg.cholesky(own)
    # At least that of independent errors, and that of either kind of strips alone.
    least = np.eye(len(own))
    for spread in (down, aside, down + aside - _spread(score, both)):
        factors, axes = np.linalg.eigh(root.T @ spread @ root - least)
        least = least + (axes * np.maximum(factors, 0.0)) @ axes.T
    return np.asarray(root @ least @ root.T)


def _strips(number: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    first, span = int(number.min()), int(np.ptp(number)) + 1
    count = min(max(span // width, _STRIPS[0]), _STRIPS[1], span)
    return (number - first) * count // span


def _spread(score: Array, group: NDArray[np.int64]) -> Array:
    """Return the sum of squares of the groups' sums; a mean and a slope are fitted to them."""
    count = int(group.max()) + 1
    sums = np.stack([np.bincount(group, column, count) for column in score.T])
    return np.asarray(sums @ sums.T * (count / max(count - 2, 1)))


def check_part(part: Part, name: str) -> None:
    """Refuse points that are too few for a plane or on one line with an ArgumentError."""
    lines = len(np.unique(part.line))
    columns = len(np.unique(part.column))
    if len(part.line) < POINTS_MIN or lines < 3 or columns < 3:
        raise ArgumentError(
            f"{name} has {len(part.line):,} points in {lines} periods and {columns} columns; "
            f"choose a region with {POINTS_MIN} points or more in 3 of each"
        )
    check_extent(part.xyz, name)


def check_extent(xyz: Array, name: str) -> None:
    """Refuse points, (n, 3) in mm, of one line or one stage position with an ArgumentError."""
    span_mm = np.ptp(xyz[:, 1:], axis=0)
    if span_mm.min() < _EXTENT_MIN_MM:
        raise ArgumentError(
            f"{name} extends {span_mm[0]:.3g} mm along y and {span_mm[1]:.3g} mm along z; "
            "a surface needs an extent in both: give a sweep"
        )


def flatness(part: Part, plane: Plane) -> Flatness:
    """Return the flatness of a part about its plane; NaN when it is too small for four cells.

    Left out are points far from the others of their cell. Those far from the plane, yet not alone,
    are form: a dent or a pocket.
    """
    fine = 4
    cells, down, aside = (
        _cells(part.line, part.column, count) for count in ((1, 1), (fine, 1), (1, fine))
    )
    kept = _alike(plane.residual / part.sigma, cells)
    residual, sigma = plane.residual[kept], part.sigma[kept]
    cells, down, aside = cells[kept], down[kept], aside[kept]
    total = int(cells.max()) + 1
    count = np.bincount(cells, minlength=total)
    mean = np.bincount(cells, residual, total) / np.maximum(count, 1)
    used = count >= 0.25 * np.median(count[count > 0])
    own = np.bincount(cells, sigma**2, total) / np.maximum(count, 1) ** 2
    variance = own * max(1.0, *(_excess(residual, at, cells, used, own) for at in (down, aside)))
    # A plane follows three cells by itself.
    if np.count_nonzero(used) < 4:
        return Flatness(Value(np.nan, np.nan), np.nan)
    from scipy.special import ndtri

    mean, sigma = mean[used] * plane.cosine, np.sqrt(variance[used]) * plane.cosine
    high, low = int(np.argmax(mean)), int(np.argmin(mean))
    # Blom's mean of the largest of n Gaussian numbers, on both sides.
    largest = float(ndtri((len(mean) - 0.375) / (len(mean) + 0.25)))
    return Flatness(
        Value(float(mean[high] - mean[low]), float(np.hypot(sigma[high], sigma[low]))),
        2.0 * largest * float(np.median(sigma)),
    )


def _alike(ratio: Array, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which points are within 4 robust sigma of the median of their cell."""
    alike = np.zeros(len(ratio), bool)
    for cell in np.unique(cells):
        at = np.flatnonzero(cells == cell)
        off = np.abs(ratio[at] - np.median(ratio[at]))
        alike[at] = off <= CUT_SIGMA * max(SIGMA_PER_MAD * float(np.median(off)), 1.0)
    return alike


def _cells(
    line: NDArray[np.int64], column: NDArray[np.int64], fine: tuple[int, int]
) -> NDArray[np.int64]:
    """Return the cell of every point, of 8 x 8 times ``fine``."""
    parts = []
    for number, times, strip in zip(
        (line, column), fine, (_STRIP_LINES, _STRIP_COLUMNS), strict=True
    ):
        first, span = int(number.min()), int(np.ptp(number)) + 1
        # Two strips: a cell is divided, and neighbours' errors are alike.
        coarse = min(_FLAT_CELLS, max(span // (2 * strip), 1))
        parts.append(((number - first) * coarse * times // span, coarse * times))
    (down, _), (aside, width) = parts
    return down * width + aside


def _excess(
    residual: Array, fine: NDArray[np.int64], cells: NDArray[np.int64], used: NDArray[np.bool_],
    own: Array,
) -> float:  # fmt: skip
    """Return by how much the means of cells scatter more than their own sigmas state.

    Each cell is divided into four strips, and the variance of its mean is a quarter of theirs.
    """
    total = int(fine.max()) + 1
    count = np.bincount(fine, minlength=total)
    at = count > 0
    mean = np.bincount(fine, residual, total)[at] / count[at]
    cell = np.zeros(total, np.int64)
    cell[fine] = cells
    cell = cell[at]
    strips = np.bincount(cell, minlength=len(used))
    inside = np.bincount(cell, mean, len(used)) / np.maximum(strips, 1)
    square = np.bincount(cell, (mean - inside[cell]) ** 2, len(used))
    whole = used & (strips == 4)
    if not whole.any():
        return 1.0
    return float((square[whole] / 3.0 / 4.0).sum() / own[whole].sum())
