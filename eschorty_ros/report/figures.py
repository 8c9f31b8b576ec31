"""Pictures of a cloud: depth map, 3-D view, range error and error against sigma.

Every function returns a matplotlib figure without a window; `save` writes it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import atomic_write
from eschorty_ros.report.accuracy import stage_and_range_mm
from eschorty_ros.surfaces.profiles import period_s, profile_index

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from eschorty_ros.core.optics import DesignTable

POINTS_IN_2D = 200_000
POINTS_IN_3D = 30_000
TICKS_IN_3D = 5
LABEL_PAD = 6.0
SHORT_SIDE = 0.4
LONG_MAP = 8.0
# Width of a map, height of what is above and below it, and of a row at least and at most; inches.
MAP_IN, BAR_IN, ROWS_IN = 5.4, 1.9, (3.8, 4.9)
SIGMAS_SHOWN = 5.0
DPI = 110
PIXELS_MAX = 200_000_000


def scan_figure(
    points: NDArray[np.void],
    error_mm: NDArray[np.float64] | None = None,
    title: str = "",
    stage_direction: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Figure:
    """Draw depth map and 3-D view; with a known error, its map and its histogram too.

    - ``points``: POINT_DTYPE, shape (n,).
    - ``error_mm``: Shape (n,). Measured minus true range; NaN where the truth is unknown.

    Raises ``ArgumentError`` when the cloud is empty.
    """
    stage_mm, range_mm = stage_and_range_mm(points, stage_direction)
    grid = grid_of(points, stage_mm)
    rows = 1 if error_mm is None else 2
    # A view alone needs all the height.
    figure = new_figure(12.0, ROWS_IN[1] if rows == 1 else 2.0 * _row_in(grid))
    if title:
        figure.suptitle(title, parse_math=False)
    limits = central(range_mm)
    halves: Any = figure.subfigures(1, 2)
    left, right = halves
    # The view needs more room than the histogram below it, and some for its labels.
    beside = right.add_gridspec(2, 1, height_ratios=(9, 6 if rows == 2 else 1), hspace=0.2)
    axes = left.add_subplot(rows, 1, 1)
    draw_map(axes, grid, image_of(grid, points, range_mm), "range (mm)", "viridis", limits)
    axes.set_title("Depth map")
    _view_3d(right.add_subplot(beside[0], projection="3d"), points, range_mm, limits)
    if error_mm is not None:
        bound = _error_bound(error_mm)
        axes = left.add_subplot(rows, 1, 2)
        draw_map(
            axes,
            grid,
            image_of(grid, points, error_mm),
            "range error (mm)",
            "RdBu_r",
            (-bound, bound),
        )
        axes.set_title("Measured minus true range")
        _histogram(right.add_subplot(beside[1]), error_mm, points["sigma"] * 1e3)
    return figure


def _row_in(grid: Grid) -> float:
    """Return the height of a map with its colour bar, in inches: less where it is wide."""
    across = float(np.ptp(_line_edges(grid.stage_mm)) / np.ptp(grid.along_mm))
    return float(np.clip(MAP_IN * across + BAR_IN, *ROWS_IN))


def cloud_figure(points: NDArray[np.void], title: str) -> Figure:
    """Draw points of which only the places are known: a view along x and a 3-D view.

    - ``points``: POINT_DTYPE, shape (n,), at least one.
    """
    figure = new_figure(12.0, 4.9)
    figure.suptitle(title, parse_math=False)
    range_mm = points["x"].astype(np.float64) * 1e3
    limits = central(range_mm)
    axes = figure.add_subplot(1, 2, 1)
    shown = slice(None, None, max(len(points) // POINTS_IN_2D, 1))
    artist = axes.scatter(
        points["z"][shown] * 1e3, points["y"][shown] * 1e3, c=range_mm[shown], s=1.0,
        linewidths=0.0, cmap="viridis", vmin=limits[0], vmax=limits[1],
    )  # fmt: skip
    axes.set(xlabel="z (mm)", ylabel="y (mm)", title="View along x", aspect="equal")
    figure.colorbar(artist, ax=axes, label="x (mm)", extend="both", location="bottom")
    _view_3d(figure.add_subplot(1, 2, 2, projection="3d"), points, range_mm, limits)
    return figure


def design_figure(table: DesignTable, title: str) -> Figure:
    """Draw range over row, and sampling and depth of field over range."""
    figure = new_figure(12.0, 4.2)
    figure.suptitle(title)
    axes = figure.add_subplot(1, 3, 1)
    axes.plot(table.row, table.range_mm)
    axes.set(xlabel="sensor row (px)", ylabel="range (mm)", title="Range over row")
    axes.grid(alpha=0.3)
    axes = figure.add_subplot(1, 3, 2)
    axes.plot(table.range_mm, table.range_per_row_mm, label="range step of one row")
    axes.plot(table.range_mm, table.lateral_pitch_mm, label="lateral step of one column")
    axes.set(xlabel="range (mm)", ylabel="step (mm/px)", title="Sampling", ylim=(0.0, None))
    axes.legend()
    axes.grid(alpha=0.3)
    axes = figure.add_subplot(1, 3, 3)
    axes.plot(table.range_mm, table.depth_of_field_mm)
    axes.set(
        xlabel="range (mm)",
        ylabel="± depth of field (mm)",
        title="Depth of field",
        ylim=(0.0, None),
    )
    axes.grid(alpha=0.3)
    return figure


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure; the extension (.png, .pdf, .svg) decides the format.

    Raises ``ArgumentError`` when the path cannot be written or its extension is unknown.
    """
    target = Path(path)
    try:
        with atomic_write(target) as stream:
            figure.savefig(stream, format=target.suffix[1:].lower(), dpi=DPI)
    except ArgumentError:
        raise
    except (OSError, ValueError) as error:
        raise ArgumentError(f"cannot write the picture {path}: {error}") from error


@dataclass(frozen=True, slots=True)
class Grid:
    """Axes of a cloud's map, one line per modulation period, one pixel per column."""

    along_mm: NDArray[np.float64]
    """Shape (columns + 1,). Edges of the columns along the line, at the mean range; px where the
    points do not show it."""
    along_label: str
    stage_mm: NDArray[np.float64]
    """Shape (profiles,). Median stage position of each line."""
    profile: NDArray[np.int64]
    """Shape (n,). Line of every point."""


def grid_of(points: NDArray[np.void], stage_mm: NDArray[np.float64]) -> Grid:
    """Return the points sorted into modulation periods.

    Raises ``ArgumentError`` when the cloud is empty.
    """
    if len(points) == 0:
        raise ArgumentError("the cloud has 0 points; give one with points to draw")
    period = period_s(points)
    profile = (
        profile_index(points, period) if period > 0.0 else np.zeros(len(points), dtype=np.int64)
    )
    lines = int(profile.max()) + 1
    columns = int(points["column"].max()) + 1
    if lines * columns > PIXELS_MAX:
        raise ArgumentError(
            f"the cloud spans {lines:,} periods of {columns:,} columns; give one of at most "
            f"{PIXELS_MAX:,} pixels to draw"
        )
    counts = np.bincount(profile, minlength=lines)
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.bincount(profile, weights=stage_mm, minlength=lines) / counts
    index = np.arange(lines)
    known = counts > 0
    positions = np.interp(index, index[known], middle[known])
    edges = np.asarray(np.arange(columns + 1) - 0.5, np.float64)
    slope, offset = _along_line(points)
    if not slope > 0.0:
        return Grid(edges, "column (px)", positions, profile)
    return Grid(np.asarray(offset + slope * edges), "along the line (mm)", positions, profile)


def _along_line(points: NDArray[np.void]) -> tuple[float, float]:
    """Return slope and offset of z over the column, mm: the lateral scale at the mean range."""
    column, z_mm = points["column"].astype(np.float64), points["z"].astype(np.float64) * 1e3
    from_mean = column - column.mean()
    slope = float(from_mean @ z_mm) / max(float(from_mean @ from_mean), 1.0)
    return slope, float(z_mm.mean() - slope * column.mean())


def image_of(
    grid: Grid, points: NDArray[np.void], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values of the points as an image, shape (profiles, columns); NaN without a point."""
    image = np.full((len(grid.stage_mm), len(grid.along_mm) - 1), np.nan)
    image[grid.profile, points["column"].astype(np.intp)] = values
    return image


def _rests(stage_mm: NDArray[np.float64]) -> bool:
    return float(np.ptp(stage_mm)) < 1e-6


def _line_edges(stage_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the limits of a map's lines in rising order, one more than there are lines.

    Lines differ in height while the stage accelerates; with the stage at rest their height is 1.
    """
    at = np.sort(stage_mm)
    if _rests(stage_mm):
        return at[0] + np.linspace(-0.5, 0.5, at.size + 1)
    between = 0.5 * (at[1:] + at[:-1])
    return np.concatenate(([2 * at[0] - between[0]], between, [2 * at[-1] - between[-1]]))


def central(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return limits that do not depend on a few outliers."""
    low, high = np.nanpercentile(values, [0.5, 99.5])
    margin = max(0.05 * (high - low), 0.5)
    return float(low - margin), float(high + margin)


def _error_bound(error_mm: NDArray[np.float64]) -> float:
    """Return a symmetric limit on the scale of the noise; depth edges exceed it."""
    size_mm = np.abs(error_mm[np.isfinite(error_mm)])
    return max(3.0 * float(np.percentile(size_mm, 68.0)), 1e-3) if size_mm.size else 1.0


def draw_map(
    axes: Axes,
    grid: Grid,
    image: NDArray[np.float64],
    label: str,
    colours: str,
    limits: tuple[float, float],
) -> None:
    """Draw an image of a grid, with its proportions and a colour bar."""
    edges_mm = _line_edges(grid.stage_mm)
    artist = axes.pcolorfast(
        grid.along_mm,
        edges_mm,
        image[np.argsort(grid.stage_mm, kind="stable")],
        cmap=colours,
        vmin=limits[0],
        vmax=limits[1],
    )
    axes.set_facecolor("0.85")
    axes.set(xlabel=grid.along_label, ylabel="stage position (mm)")
    if _rests(grid.stage_mm):
        axes.set(ylabel=f"profiles, stage at {grid.stage_mm[0]:g} mm", yticks=[])
    width, height = np.ptp(grid.along_mm), np.ptp(edges_mm)
    if max(width, height) < LONG_MAP * min(width, height):
        axes.set_aspect("equal")
    below = width > 1.5 * height
    axes.figure.colorbar(
        artist, ax=axes, label=label, extend="both", location="bottom" if below else "right"
    )


def _view_3d(
    axes: Any, points: NDArray[np.void], range_mm: NDArray[np.float64], limits: tuple[float, float]
) -> None:
    shown = np.flatnonzero((range_mm >= limits[0]) & (range_mm <= limits[1]))
    if shown.size > POINTS_IN_3D:
        shown = np.random.default_rng(0).choice(shown, POINTS_IN_3D, replace=False)
    cloud = points[shown]
    axes.scatter(
        cloud["y"] * 1e3,
        cloud["x"] * 1e3,
        cloud["z"] * 1e3,
        c=range_mm[shown],
        cmap="viridis",
        vmin=limits[0],
        vmax=limits[1],
        s=1.0,
        linewidths=0.0,
        depthshade=False,
    )
    axes.set_xlabel("y, stage (mm)", labelpad=LABEL_PAD)
    axes.set_ylabel("x, range (mm)", labelpad=LABEL_PAD)
    axes.set_zlabel("z, line (mm)")
    axes.set_title(f"Point cloud ({shown.size:,} points shown)")
    _true_to_scale(axes, np.stack([cloud[name] for name in "yxz"]) * 1e3)
    # From the sensor's view with the line upright, y points to the left.
    axes.invert_xaxis()
    axes.view_init(elev=18.0, azim=-58.0)


def _true_to_scale(axes: Any, xyz_mm: NDArray[np.floating[Any]]) -> None:
    """Set the same scale for all axes, with room for the labels of a short one."""
    from matplotlib.ticker import MaxNLocator

    low, high = xyz_mm.min(axis=1), xyz_mm.max(axis=1)
    longest = max(float(np.max(high - low)), 1.0)
    spans = np.maximum(high - low, SHORT_SIDE * longest)
    middle = 0.5 * (low + high)
    low, high = middle - 0.5 * spans, middle + 0.5 * spans
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(spans, zoom=0.85)
    for k, axis in enumerate((axes.xaxis, axes.yaxis, axes.zaxis)):
        count = max(round(TICKS_IN_3D * spans[k] / longest), 3)
        ticks = MaxNLocator(count).tick_values(low[k], high[k])
        # In a corner the labels of two axes would overlap.
        inner = (ticks > low[k] + 0.1 * spans[k]) & (ticks < high[k] - 0.02 * spans[k])
        axis.set_ticks(ticks[inner])
        axis.set_tick_params(labelsize="small")
        axis.labelpad = 9
    axes.zaxis.set_tick_params(pad=10)
    axes.zaxis.labelpad = 16


def _histogram(
    axes: Axes, error_mm: NDArray[np.float64], sigma_mm: NDArray[np.floating[Any]]
) -> None:
    ratio = error_mm / sigma_mm
    ratio = ratio[np.isfinite(ratio)]
    edges = np.linspace(-SIGMAS_SHOWN, SIGMAS_SHOWN, 81)
    weights = np.full(ratio.size, 1.0 / max(ratio.size, 1) / (edges[1] - edges[0]))
    axes.hist(ratio, edges.tolist(), weights=weights, color="tab:blue", alpha=0.75, label="points")
    axes.plot(edges, np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi), "k--", label="unit normal")
    beyond = float(np.mean(np.abs(ratio) > SIGMAS_SHOWN)) if ratio.size else 0.0
    axes.set(
        xlabel="range error / its sigma",
        ylabel="density",
        title=f"Error against the reported sigma ({beyond:.1%} beyond ±{SIGMAS_SHOWN:g})",
    )
    axes.legend()
    axes.grid(alpha=0.3)
