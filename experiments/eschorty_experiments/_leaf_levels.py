"""Resolution of leaves 2.2 mm apart: the levels of the collage's middle layer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction import Result, Settings
from eschorty_ros.report.accuracy import stage_and_range_mm
from eschorty_ros.report.figures import grid_of, image_of, new_figure
from eschorty_ros.simulation.scenes import LEVELS, SEPARATION_MM, Leaves

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EDGE_MM = 3.0
"""Half of the footprint along the stage: nearer to a leaf's rim the line is on two leaves."""

EDGE_COLUMNS = Settings().smoothing_half_width + 1
"""One more than the default smoothing reaches."""

VEINLESS_MM = 0.05


@dataclass(frozen=True, slots=True)
class LevelStep:
    """Two neighbouring levels."""

    near: int
    far: int
    """Numbers of the levels."""
    step_mm: float
    """Difference of their mean ranges."""
    scatter_mm: float
    """Root mean square of their standard deviations."""
    d_prime: float
    """``step_mm / scatter_mm``: separation of the two by single points."""
    points: int
    """Points of the smaller one."""


def level_residuals(
    leaves: Leaves, result: Result, model: RangeModel, pitch_mm: float
) -> NDArray[np.float64]:
    """Return level of the middle layer and range relative to it, for points well inside a blade.

    Shape (n, 2): level (0, 1, 2), and range minus curvature minus the first level's range, mm.

    - ``result``: A scan of ``leaves``.
    - ``pitch_mm``: Stage travel per period.
    """
    points = result.points
    stage_mm, range_mm = stage_and_range_mm(points)
    grid = grid_of(points, stage_mm)
    columns = np.arange(model.columns)
    leaf = leaves.leaf_index(grid.stage_mm, columns, model)
    inside = _inside(leaf, math.ceil(EDGE_MM / pitch_mm))
    truth_mm = leaves.range_mm(grid.stage_mm, columns, model)
    curved_mm = leaves.curvature_mm(
        grid.stage_mm[:, np.newaxis], model.lateral_mm(columns, truth_mm)
    )
    depth_mm = np.array([item.depth_mm for item in leaves.leaves])[leaf]
    level = np.rint((depth_mm - leaves.centre_mm) / SEPARATION_MM)
    known = inside & (level >= 0) & (level < LEVELS)
    known &= depth_mm + curved_mm - truth_mm < VEINLESS_MM
    measured_mm = image_of(grid, points, range_mm)
    width = measured_mm.shape[1]
    found = known[:, :width] & np.isfinite(measured_mm)
    residual_mm = (measured_mm - curved_mm[:, :width])[found] - leaves.centre_mm
    return np.column_stack((level[:, :width][found], residual_mm))


def _inside(leaf: NDArray[np.intp], lines: int) -> NDArray[np.bool_]:
    """Return a mask of places with the same leaf ``lines`` lines and a few columns each way."""
    inside = leaf >= 0
    for axis, reach in ((0, lines), (1, EDGE_COLUMNS)):
        for shift in range(1, reach + 1):
            for signed in (shift, -shift):
                inside &= np.roll(leaf, signed, axis) == leaf
    inside[:lines] = inside[-lines:] = False
    inside[:, :EDGE_COLUMNS] = inside[:, -EDGE_COLUMNS:] = False
    return inside


def level_steps(residuals: NDArray[np.float64]) -> list[LevelStep]:
    """Compare every level with the next; residuals as `level_residuals` gives them."""
    steps = []
    for near in range(LEVELS - 1):
        first, second = (residuals[residuals[:, 0] == near + k, 1] for k in (0, 1))
        if min(first.size, second.size) < 2:
            steps.append(LevelStep(near, near + 1, math.nan, math.nan, math.nan, 0))
            continue
        step_mm = float(second.mean() - first.mean())
        scatter_mm = math.sqrt(0.5 * float(first.var(ddof=1) + second.var(ddof=1)))
        steps.append(
            LevelStep(
                near,
                near + 1,
                step_mm,
                scatter_mm,
                step_mm / scatter_mm,
                min(first.size, second.size),
            )
        )
    return steps


def level_figure(residuals: dict[str, NDArray[np.float64]]) -> Figure:
    """Draw histograms of the three levels, one panel per scan."""
    figure = new_figure(6.0 * len(residuals), 4.0)
    edges = np.linspace(-2.5, (LEVELS - 1) * SEPARATION_MM + 2.5, 100)
    for k, (label, values) in enumerate(residuals.items()):
        axes = figure.add_subplot(1, len(residuals), k + 1)
        for level in range(LEVELS):
            at = values[values[:, 0] == level, 1]
            axes.hist(
                at, edges.tolist(), density=True, alpha=0.6, label=f"level {level} ({at.size:,})"
            )
            axes.axvline(level * SEPARATION_MM, color="k", linestyle="--", linewidth=1.0)
        axes.set(xlabel="range behind the first level (mm)", ylabel="density (1/mm)", title=label)
        axes.set_ylim(top=1.3 * axes.get_ylim()[1])
        axes.legend(title="true level (points)", ncols=LEVELS, loc="upper center")
        axes.grid(alpha=0.3)
    return figure
