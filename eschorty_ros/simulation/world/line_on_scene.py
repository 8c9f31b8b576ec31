"""The laser line's thickness on a scene: one patch per column, two across an edge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes import Scene

_SAMPLES = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
"""Samples of the scene across the line, in its half widths."""
_CENTRE = 2
_FINE = 32
"""Parts into which the interval between two samples is divided to find an edge."""
_ROW_JUMP = 0.25
_REFLECTANCE_JUMP = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class LineOnScene:
    """The line on the scene at one stage position."""

    row: Array
    reflectance: Array
    """Row of the middle of the line and reflectance there, shape (columns,); NaN where it hits
    nothing."""
    thickness: Array
    """Rows of the line's thickness over those on a surface across the sheet, shape (columns,)."""
    split: NDArray[np.int64]
    """Columns in which an edge is within the thickness of the line, shape (n,)."""
    patch_row: Array
    patch_reflectance: Array
    patch_thickness: Array
    low_row: Array
    high_row: Array
    """The two patches of each of these columns, shape (n, 2), arguments of
    :meth:`PixelArray.relight`."""


def line_on_scene(
    scene: Scene, model: RangeModel, stage_mm: float, half_rows: float
) -> LineOnScene:
    """Return the line on the scene across its thickness.

    Rows ``d`` above the line's centre image the scene ``d / rows_per_mm_off_sheet`` behind the
    sheet. Only a jump of range or reflectance makes a second patch; a smooth surface has the range
    and the slope in the middle of the line. Where it slopes by ``s`` rows per mm, the line is
    ``|1 - s / rows_per_mm_off_sheet|`` times as thick.

    - ``half_rows``: Rows from the line's centre to where it fades.
    """
    columns = np.arange(model.columns)
    at_middle = scene.range_mm(np.array([stage_mm]), columns, model)
    hit = at_middle[np.isfinite(at_middle)]
    # Where the middle hits nothing the scene may begin beside it, at an unknown range.
    nearest_mm = float(hit.max()) if hit.size else float(model.range_mm(model.rows / 2))
    half_mm = half_rows / float(model.rows_per_mm_off_sheet(nearest_mm))
    stages = stage_mm + _SAMPLES * half_mm
    range_mm = scene.range_mm(stages, columns, model)
    reflectance = scene.reflectance(stages, columns, model)
    row = model.row(range_mm, columns)
    step = _jumps(row, reflectance)
    # The edge next to the middle, of the four stretches between samples.
    order = np.array([1, 2, 0, 3])
    first = order[np.argmax(step[order], axis=0)]
    suspects = np.flatnonzero(step.any(axis=0))
    parts = [
        _edges(scene, model, stage_mm, stages[k : k + 2], suspects[first[suspects] == k])
        for k in range(_SAMPLES.size - 1)
        if (first[suspects] == k).any()
    ]
    edge_mm, there_row, there_reflectance, split = (
        (np.concatenate(values) for values in zip(*parts, strict=True))
        if parts
        else (np.empty(0), np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))
    )
    here_row, here_reflectance = row[_CENTRE, split], reflectance[_CENTRE, split]
    patch_row = np.column_stack((here_row, there_row))
    with np.errstate(invalid="ignore"):
        per_mm = model.rows_per_mm_off_sheet(model.range_mm(patch_row, split[:, np.newaxis]))
    ahead = (edge_mm > 0.0)[:, np.newaxis]
    first, last = np.full((2, model.columns), [[_CENTRE - 1], [_CENTRE + 1]])
    # Beside an edge the slope is that of the other side.
    first[split[edge_mm < 0.0]], last[split[edge_mm > 0.0]] = _CENTRE, _CENTRE
    slope = (row[last, columns] - row[first, columns]) / (stages[last] - stages[first])
    with np.errstate(invalid="ignore"):
        narrowed = slope / model.rows_per_mm_off_sheet(range_mm[_CENTRE])
    # Beside nothing the slope is unknown.
    thickness = np.abs(1.0 - np.nan_to_num(narrowed))
    border = patch_row - edge_mm[:, np.newaxis] * per_mm
    middle = np.array([True, False])
    # The surface ahead of the edge (+y) is below it on the sensor.
    below = ahead != middle
    dark = np.isnan(patch_row)
    patch_reflectance = np.column_stack((here_reflectance, there_reflectance))
    return LineOnScene(
        row=row[_CENTRE],
        reflectance=reflectance[_CENTRE],
        thickness=thickness,
        split=split,
        patch_row=patch_row,
        patch_reflectance=np.where(dark, 0.0, patch_reflectance),
        patch_thickness=np.column_stack((thickness[split], np.ones(split.size))),
        low_row=np.where(below | dark, -np.inf, border),
        high_row=np.where(below & ~dark, border, np.inf),
    )


def _jumps(row: Array, reflectance: Array) -> NDArray[np.bool_]:
    """Return a mask of differing neighbours along the first axis, one shorter than the samples."""
    lit = np.isfinite(row)
    with np.errstate(invalid="ignore"):
        far = np.abs(np.diff(row, axis=0)) > _ROW_JUMP
        bright = np.abs(np.diff(reflectance, axis=0)) > _REFLECTANCE_JUMP
    both = lit[1:] & lit[:-1]
    return np.asarray((both & (far | bright)) | (lit[1:] != lit[:-1]))


class _Edges(NamedTuple):
    """Edges between two samples: distance ahead of the middle, and what is beyond in a column."""

    ahead_mm: Array
    row: Array
    reflectance: Array
    column: NDArray[np.int64]


def _edges(
    scene: Scene, model: RangeModel, stage_mm: float, stretch: Array, columns: NDArray[np.int64]
) -> _Edges:
    """Return the edges of columns between two samples.

    Columns with a slope instead of an edge are left out.
    """
    stages = np.linspace(stretch[0], stretch[1], _FINE + 1)
    range_mm = scene.range_mm(stages, columns, model)
    row = model.row(range_mm, columns)
    reflectance = scene.reflectance(stages, columns, model)
    each = np.arange(columns.size)
    lit = np.isfinite(row)
    size = np.where(
        lit[1:] & lit[:-1],
        np.abs(np.diff(row, axis=0)) / _ROW_JUMP
        + np.abs(np.diff(reflectance, axis=0)) / _REFLECTANCE_JUMP,
        np.where(lit[1:] != lit[:-1], np.inf, 0.0),
    )
    at = np.argmax(size, axis=0)
    # A slope is spread over all parts; of an edge one part has at least half.
    total = np.where(np.isfinite(size), size, 0.0).sum(axis=0)
    largest = size[at, each]
    sharp = (largest > 1.0) & (largest >= 0.5 * total)
    edge_mm = 0.5 * (stages[at] + stages[at + 1]) - stage_mm
    beyond = np.where(edge_mm > 0.0, at + 1, at)
    return _Edges(
        edge_mm[sharp], row[beyond, each][sharp], reflectance[beyond, each][sharp], columns[sharp]
    )
