"""Pictures of measured surfaces, of meshes and of joined clouds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.report.accuracy import stage_and_range_mm
from eschorty_ros.report.figures import central, draw_map, grid_of, image_of, new_figure
from eschorty_ros.surfaces.measure import Measured
from eschorty_ros.surfaces.mesh import Mesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRIANGLES_WITH_EDGES = 3_000
POINTS_SHOWN = 20_000


def measured_figure(points: NDArray[np.void], measured: Measured, title: str) -> Figure:
    """Draw the range with every surface's number, and the residuals of the planes.

    - ``points``: POINT_DTYPE, shape (n,). The cloud that was measured.
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


def mesh_figure(mesh: Mesh, sigmas: float, title: str) -> Figure:
    """Draw the mesh as the sensor sees it, and its levels: vertices kept against error."""
    figure = new_figure(12.0, 5.0)
    figure.suptitle(title, parse_math=False)
    axes = figure.add_subplot(1, 2, 1)
    x, y, z = mesh.vertices.T
    middle = x[mesh.triangles].mean(axis=1)
    low, high = central(middle)
    few = len(mesh.triangles) <= TRIANGLES_WITH_EDGES
    artist = axes.tripcolor(
        z, y, mesh.triangles, facecolors=middle, cmap="viridis", vmin=low, vmax=high,
        edgecolors="white" if few else "none", linewidth=0.3 if few else 0.0,
    )  # fmt: skip
    axes.set(xlabel="z (mm)", ylabel="y (mm)", aspect="equal")
    axes.set_title(f"{len(x):,} vertices, {len(mesh.triangles):,} triangles")
    axes.set_facecolor("0.85")
    figure.colorbar(artist, ax=axes, label="range (mm)", location="bottom")
    axes = figure.add_subplot(1, 2, 2)
    kept = [level.vertices / mesh.points for level in mesh.levels]
    errors = [level.error_sigmas for level in mesh.levels]
    axes.semilogx(kept, errors, "o-")
    axes.plot(kept[mesh.chosen], errors[mesh.chosen], "o", markersize=12, fillstyle="none")
    axes.axhline(sigmas, color="black", linestyle="--")
    axes.set(
        xlabel="share of the points kept", ylabel="95 % of the points within (sigma)",
        title="Points kept against error",
    )  # fmt: skip
    axes.grid(alpha=0.3)
    return figure


def joined_figure(points: NDArray[np.void], sizes: Sequence[int], title: str) -> Figure:
    """Draw joined clouds along x and along z, each in its colour; ``sizes`` are their points."""
    figure = new_figure(12.0, 5.0)
    figure.suptitle(title, parse_math=False)
    for place, across in ((1, "z"), (2, "x")):
        axes = figure.add_subplot(1, 2, place)
        begin = 0
        for number, size in enumerate(sizes, 1):
            part = points[begin : begin + size : max(size // POINTS_SHOWN, 1)]
            begin += size
            axes.plot(
                part[across] * 1e3, part["y"] * 1e3, ".", markersize=1.5, alpha=0.5,
                label=f"cloud {number}",
            )  # fmt: skip
        axes.set(xlabel=f"{across} (mm)", ylabel="y (mm)", aspect="equal")
    handles, labels = axes.get_legend_handles_labels()
    # Beside the axes: a flat cloud leaves no room in them.
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(len(sizes), 8), markerscale=8
    )
    return figure
