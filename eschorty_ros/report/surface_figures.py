"""Pictures of measured surfaces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.report.accuracy import stage_and_range_mm
from eschorty_ros.report.figures import central, draw_map, grid_of, image_of, new_figure
from eschorty_ros.surfaces.measure import Measured

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def measured_figure(points: NDArray[np.void], measured: Measured, title: str) -> Figure:
    """Draw the range with every surface's number, and the residuals of the planes.

    Parameters
    ----------
    points : ndarray of POINT_DTYPE, shape (n,)
        The cloud that was measured.
    measured : Measured
    title : str
    """
    points = points[measured.grid.point[measured.grid.known]]
    residual = np.full(measured.grid.point.shape, np.nan)
    for surface in measured.surfaces:
        plane, part = surface.plane, surface.part
        residual[part.line, part.column] = np.where(plane.kept, plane.residual, np.nan)
    residual_mm = residual[measured.grid.known]
    bound = float(np.nanpercentile(np.abs(residual_mm), 99.0)) or 1.0
    stage_mm, range_mm = stage_and_range_mm(points)
    grid = grid_of(points, stage_mm)
    middle_mm = 0.5 * (grid.along_mm[1:] + grid.along_mm[:-1])
    figure = new_figure(12.0, 5.0)
    figure.suptitle(title, parse_math=False)
    for place, values, label, colours, limits in (
        (1, range_mm, "range (mm)", "viridis", central(range_mm)),
        (2, residual_mm, "measured minus plane (mm)", "RdBu_r", (-bound, bound)),
    ):
        axes = figure.add_subplot(1, 2, place)
        draw_map(axes, grid, image_of(grid, points, values), label, colours, limits)
        for number, surface in enumerate(measured.surfaces, 1):
            column = int(np.median(surface.part.column)) + measured.grid.first_column
            axes.text(
                middle_mm[column], surface.plane.centre[1], str(number), ha="center", va="center",
                bbox={"facecolor": "white", "alpha": 0.7, "linewidth": 0},
            )  # fmt: skip
    return figure
