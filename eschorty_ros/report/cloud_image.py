"""A cloud as an image: modulation periods by columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.report.profiles import period_s, profile_index


@dataclass(frozen=True, slots=True)
class Grid:
    """A cloud as an image: one line per modulation period, one pixel per column.

    Attributes
    ----------
    columns : int
        Width of ``values``.
    stage_mm : ndarray of float64, shape (profiles,)
        Median stage position of each line.
    profile : ndarray of int64, shape (n,)
        Line of every point.
    """

    columns: int
    stage_mm: NDArray[np.float64]
    profile: NDArray[np.int64]


def grid_of(points: NDArray[np.void], stage_mm: NDArray[np.float64]) -> Grid:
    """Return the points sorted into modulation periods.

    Raises
    ------
    ArgumentError
        When the cloud is empty.
    """
    if len(points) == 0:
        raise ArgumentError("the cloud holds 0 points; there is nothing to draw")
    period = period_s(points)
    profile = (
        profile_index(points, period) if period > 0.0 else np.zeros(len(points), dtype=np.int64)
    )
    lines = int(profile.max()) + 1
    counts = np.bincount(profile, minlength=lines)
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.bincount(profile, weights=stage_mm, minlength=lines) / counts
    index = np.arange(lines)
    known = counts > 0
    positions = np.interp(index, index[known], middle[known])
    return Grid(int(points["column"].max()) + 1, positions, profile)


def image_of(
    grid: Grid, points: NDArray[np.void], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values of the points as an image, shape (profiles, columns); NaN without a point."""
    image = np.full((len(grid.stage_mm), grid.columns), np.nan)
    image[grid.profile, points["column"].astype(np.intp)] = values
    return image


def line_edges(stage_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rising limits of a map's lines, one more than there are lines.

    The stage accelerates, so that lines differ in height; a stage at rest gives lines of height 1.
    """
    at = np.sort(stage_mm)
    if at[-1] - at[0] < 1e-6:
        return at[0] + np.linspace(-0.5, 0.5, at.size + 1)
    between = 0.5 * (at[1:] + at[:-1])
    return np.concatenate(([2 * at[0] - between[0]], between, [2 * at[-1] - between[-1]]))
