"""Posts in an aggregated frame: their rows, columns and widths with standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.numbers import number
from eschorty_ros.core.calibration.aggregate_frame import AggregateFrame
from eschorty_ros.core.line import HALF_WIDTH_PER_FWHM, SIGMA_FLOOR_PX

COLUMNS_MIN = 8
"""Columns of the narrowest target."""
_ROW_JUMP_PX = 4.0
_GAP_COLUMNS = 2
_INNER = 0.6
_CURVED_MIN = 12
_SIGNIFICANCE = 6.0
_CENTRING_STEPS = 12
_HOT_SHARE, _HOT_COUNTS = 2.0, 10.0
GRID_SIGMA_PX = 0.15
"""Error of a resting line's row that the pixels' grid causes in all columns alike.

It is 0.05 px RMS with the noise of simulated pixels, 0.3 px without any.
"""
# The standard deviation of a uniform distribution: an edge is anywhere between two columns.
_EDGE_SIGMA_PX = 12.0**-0.5


@dataclass(frozen=True, slots=True)
class Post:
    """One post in a capture."""

    column: float
    row: float
    """The middle between its two edges on the sensor, and the line's row there, px."""
    sigma_row: float
    """Standard deviation of ``row``, px: the scatter of its columns and `GRID_SIGMA_PX`."""
    width_px: float
    sigma_width_px: float
    """Columns between its edges, where the counts fall to half of the plateau."""
    events: int
    """Events of its line."""
    row_cut: bool = False
    column_cut: bool = False
    """The sensor's first or last row cuts the line (its row is biased), or the first or last column
    the post (its width and middle are unknown)."""


def find_posts(frame: AggregateFrame, line_width_px: float = 20.0) -> list[Post]:
    """Find runs of neighbouring columns whose line keeps its row.

    The row of a column is the centroid of the counts in a window around the line's densest
    place. The window is centred on the centroid itself, so that uniform background does not bias
    it. The row of a post is that of a parabola through the rows of its inner columns, at its
    middle, which fits flat, tilted and round posts.

    - ``line_width_px``: Full width of the line at half maximum, rows.

    Raises ``ArgumentError`` for a width outside the sensor.
    """
    width = number("line_width_px", line_width_px, 0.5, len(frame.counts))
    image = _Columns(frame.counts, max(HALF_WIDTH_PER_FWHM * width, 3.0))
    posts = []
    for first, last in image.runs():
        if last - first + 1 >= COLUMNS_MIN:
            posts.append(image.post(first, last, 0.5 * HALF_WIDTH_PER_FWHM * width))
    return [post for post in posts if post.width_px >= COLUMNS_MIN]


class _Columns:
    """Counts summed along the rows, so that a window's sum is a difference of two numbers."""

    def __init__(self, counts: NDArray[np.uint32], half_px: float) -> None:
        self.rows, self.columns = counts.shape
        self.half_px = half_px
        value = _without_hot_pixels(counts)
        place = np.arange(self.rows)[:, np.newaxis]
        zero = np.zeros((1, self.columns))
        self._mass = np.concatenate((zero, np.cumsum(value, axis=0)))
        self._weighted = np.concatenate((zero, np.cumsum(value * place, axis=0)))
        self.row = self._densest()
        for _ in range(_CENTRING_STEPS):
            self.row = self._centroid(self.row)
        window = 2.0 * half_px + 1.0
        inside = self._sum(self._mass, self.row)
        outside = self._mass[-1] - inside
        self.background = float(np.median(outside)) / max(self.rows - window, 1.0) * window
        self.excess = inside - self.background
        least = _SIGNIFICANCE * np.sqrt(self.background + 1.0) + _SIGNIFICANCE
        self.lit = self.excess > least

    def _sum(self, cumulated: Array, row: Array | float) -> Array:
        """Return each column's sum within ``half_px`` of ``row``, outer pixels in part."""
        column = np.arange(self.columns)
        ends = []
        for end in (row - self.half_px, row + self.half_px + 1.0):
            clipped = np.clip(np.broadcast_to(end, (self.columns,)), 0.0, float(self.rows))
            below = np.minimum(clipped.astype(np.int64), self.rows - 1)
            part = clipped - below
            low, high = cumulated[below, column], cumulated[below + 1, column]
            ends.append(low + part * (high - low))
        return np.asarray(ends[1] - ends[0])

    def _densest(self) -> Array:
        half = int(self.half_px)
        row = np.arange(self.rows)
        low, high = np.maximum(row - half, 0), np.minimum(row + half + 1, self.rows)
        return np.argmax(self._mass[high] - self._mass[low], axis=0).astype(np.float64)

    def _centroid(self, row: Array) -> Array:
        mass = self._sum(self._mass, row)
        centre = np.divide(self._sum(self._weighted, row), mass, out=row.copy(), where=mass > 0.0)
        return np.clip(centre, 0.0, self.rows - 1.0)

    def runs(self) -> list[tuple[int, int]]:
        """Return first and last column of runs that keep their row, across a few unlit columns."""
        runs: list[tuple[int, int]] = []
        for column in np.flatnonzero(self.lit).tolist():
            index = self._continued(runs, column)
            if index is None:
                runs.append((column, column))
            else:
                runs[index] = runs[index][0], column
        return runs

    def _continued(self, runs: list[tuple[int, int]], column: int) -> int | None:
        """Return the index of the run that ``column`` continues."""
        for index in range(len(runs) - 1, -1, -1):
            last = runs[index][1]
            if column - last > _GAP_COLUMNS + 1:
                break
            if abs(self.row[column] - self.row[last]) <= _ROW_JUMP_PX:
                return index
        return None

    def post(self, first: int, last: int, line_px: float) -> Post:
        """Measure the run; ``line_px`` is half the height of its line."""
        inner = _inner(first, last)
        plateau = float(np.median(self.excess[inner]))
        along = self._sum(self._mass, float(np.median(self.row[inner]))) - self.background
        middle = (first + last) // 2
        left, left_cut = _edge(along[middle::-1], 0.5 * plateau)
        right, right_cut = _edge(along[middle:], 0.5 * plateau)
        width = right + left
        column = middle + 0.5 * (right - left)
        row, sigma_row = self._row_at(column, width)
        # Half of the plateau is known to its Poisson error; an edge is one column steep.
        sigma_edge = np.hypot(_EDGE_SIGMA_PX, 0.5 / np.sqrt(max(plateau, 1.0)))
        return Post(
            column=column,
            row=row,
            sigma_row=sigma_row,
            width_px=width,
            sigma_width_px=float(np.sqrt(2.0) * sigma_edge),
            events=round(float(self.excess[first : last + 1].sum())),
            row_cut=not line_px <= row <= self.rows - 1.0 - line_px,
            column_cut=left_cut or right_cut,
        )

    def _row_at(self, column: float, width: float) -> tuple[float, float]:
        """Return the row at ``column`` and its standard deviation, from a parabola or a mean."""
        reach = 0.5 * _INNER * width
        near = np.arange(max(round(column - reach), 0), round(column + reach) + 1)
        near = near[near < self.columns]
        near = near[self.lit[near]]
        if not near.size:
            return math.nan, math.nan
        row = self.row[near]
        kept = np.abs(row - np.median(row)) <= _ROW_JUMP_PX
        offset = (near - column) / max(reach, 1.0)
        for _ in range(3):
            count = int(kept.sum())
            if not count:
                return math.nan, math.nan
            design = np.vander(offset, 3 if count >= _CURVED_MIN else 1, increasing=True)
            used = design[kept]
            weights, *_ = np.linalg.lstsq(used, row[kept], rcond=None)
            residual = row - design @ weights
            freedom = max(count - len(weights), 1)
            scatter = float(np.sqrt(np.sum(residual[kept] ** 2) / freedom))
            scatter = max(scatter, SIGMA_FLOOR_PX)
            again = np.abs(residual) <= 4.0 * scatter
            if np.array_equal(again, kept):
                break
            kept = again
        spread = float(np.linalg.inv(used.T @ used)[0, 0])
        return float(weights[0]), float(np.hypot(scatter * np.sqrt(spread), GRID_SIGMA_PX))


def _without_hot_pixels(counts: NDArray[np.uint32]) -> Array:
    """Limit each pixel's count to the most that a line gives beside its neighbours in the row."""
    value = counts.astype(np.float64)
    beside = np.zeros_like(value)
    beside[:, 1:] = value[:, :-1]
    np.maximum(beside[:, :-1], value[:, 1:], out=beside[:, :-1])
    return np.minimum(value, _HOT_SHARE * beside + _SIGNIFICANCE * np.sqrt(beside) + _HOT_COUNTS)


def _inner(first: int, last: int) -> slice:
    margin = int(0.5 * (1.0 - _INNER) * (last - first + 1))
    return slice(first + margin, last - margin + 1)


def _edge(along: Array, half: float) -> tuple[float, bool]:
    """Return where ``along`` falls below ``half`` for good, and whether it does not."""
    low = np.flatnonzero(along < half)
    for index in low.tolist():
        beyond = along[index : index + _GAP_COLUMNS + 1]
        if (beyond < half).all():
            if index == 0:
                return 0.0, False
            inside = along[index - 1]
            part = (inside - half) / (inside - along[index])
            return index - 1 + float(part), False
    return along.size - 0.5, True
