"""Regions of a cloud and what lies between them: distance, angle, step, gap and flush."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import number
from eschorty_ros.surfaces.grid import STEP_SIGMAS, CloudGrid, links, organise, smoothed
from eschorty_ros.surfaces.plane import (
    COMMON_SHARE,
    Flatness,
    Part,
    Plane,
    Value,
    check_part,
    extent_mm,
    fit_plane,
    flatness,
    solve,
)

# Smaller pieces are no surfaces to measure: share of the points.
_PIECE_MIN = 0.02
_MEDIAN_HALF = 2
# Points near a step are on both sides of the line's thickness: cells taken off each surface.
_RIM = 3
# From there to the edge: the rim, the cell beside the step and 4 over which smoothing spreads it.
_TO_EDGE = _RIM + 5
# Residuals of a plane over the points' own sigmas, least and most.
_OWN_SIGMAS = 0.5, 1.5


class Region(NamedTuple):
    """A part of a cloud: first and last column, sweep position y from and to, mm."""

    columns: tuple[float, float]
    sweep_mm: tuple[float, float]


class Surface(NamedTuple):
    """A plane of a part and its flatness."""

    mask: NDArray[np.bool_]
    """Its cells in the grid."""
    part: Part
    plane: Plane
    flat: Flatness
    common_mm: float
    """Standard deviation of the range error that its points share."""
    whole: Part
    """The part with its rims, up to the edges that face other surfaces."""

    @property
    def range_mm(self) -> Value:
        """Return the range at the middle."""
        return self.plane.range_at(*self.plane.centre[1:])


class Pair(NamedTuple):
    """A surface against the first one."""

    distance_mm: Value
    """Along the common normal of two parallel planes; farther is positive."""
    angle_deg: Value
    """Between the two planes, each with its own slopes."""
    flush_mm: Value
    """Step where the surfaces face each other, along the first one's normal."""
    gap_mm: Value
    """Space between the facing edges along y or z; NaN where they overlap, or where points of
    neither surface are between."""


class Measured(NamedTuple):
    """A cloud's surfaces, each but the first against the first."""

    grid: CloudGrid
    surfaces: tuple[Surface, ...]
    pairs: tuple[Pair, ...]


def parse_region(text: str) -> Region:
    """Return the region of a text such as ``100:400,20:60``; an empty end is open.

    >>> parse_region("100:400,:60")
    Region(columns=(100.0, 400.0), sweep_mm=(-inf, 60.0))
    """
    try:
        columns, sweep = text.split(",")
        return Region(_span(columns), _span(sweep))
    except ValueError:
        raise ArgumentError(
            f"region {text!r} is not COLUMNS,SWEEP in px and mm, each from low to high; write it "
            "as 100:400,20:60"
        ) from None


def _span(text: str) -> tuple[float, float]:
    """Return both ends of a text such as ``20:60``; raise ``ValueError`` for any other."""
    first, last = text.split(":")
    low = float(first) if first.strip() else -math.inf
    high = float(last) if last.strip() else math.inf
    if not low <= high:
        raise ValueError(text)
    return low, high


def measure(
    points: NDArray[np.void], regions: tuple[Region, ...] = (), common_mm: float | None = None
) -> Measured:
    """Return planes, flatness and what lies between them.

    - ``points``: POINT_DTYPE, shape (n,).
    - ``regions``: Without one, the pieces that steps of the range separate, without their rims.
    - ``common_mm``: Standard deviation of a range error that all points of a surface share, and by
      which its two ends differ; by default `COMMON_SHARE` of the points' own sigma.

    Raises ``ArgumentError`` when the cloud is no sweep, a region has too few points, or
    ``common_mm`` is no number.
    """
    if common_mm is not None:
        number("common_mm", common_mm, 0.0)
    grid = organise(points)
    masks, free = [_mask(grid, region) for region in regions], None
    if not masks:
        masks, free = _found(grid)
    surfaces = tuple(
        _surface(grid, mask, common_mm, f"surface {number}") for number, mask in enumerate(masks, 1)
    )
    others = Part.of(grid, np.zeros_like(grid.known))
    if free is not None:
        surfaces = _to_edges(grid, surfaces, free)
    else:
        others = Part.of(grid, grid.known & ~np.any(masks, axis=0))
    pairs = tuple(_pair(surfaces[0], other, others) for other in surfaces[1:])
    return Measured(grid, surfaces, pairs)


def faults(measured: Measured) -> list[str]:
    """Return a line where surfaces are no planes, or scatter otherwise than their points' sigmas.

    A form finer than the cells of the flatness scatters points like errors.
    """
    numbered = list(enumerate(measured.surfaces, 1))
    bent = [str(at) for at, surface in numbered if surface.flat.of_no_plane]
    found = []
    if bent:
        found.append(
            f"no plane: {', '.join(bent)}, by flatness; slopes, distances and angles are those of "
            "the plane that fits best; choose parts with --region"
        )
    for at, surface in numbered:
        plane, sigma = surface.plane, surface.part.sigma
        ratio = float(np.sqrt(np.mean((plane.residual / sigma)[plane.kept] ** 2)))
        if ratio > _OWN_SIGMAS[1] and not surface.flat.of_no_plane:
            found.append(
                f"surface {at}: residuals are {ratio:.1f} times the points' own sigmas; it has "
                "a form finer than the cells of flatness or two levels, or the sigmas are too small"
            )
        elif ratio < _OWN_SIGMAS[0]:
            found.append(
                f"surface {at}: residuals are {ratio:.2f} of the points' own sigmas, which are "
                "too large for them"
            )
    return found


def _mask(grid: CloudGrid, region: Region) -> NDArray[np.bool_]:
    column = np.arange(grid.point.shape[1]) + grid.first_column
    inside = (column >= region.columns[0]) & (column <= region.columns[1])
    low, high = region.sweep_mm
    with np.errstate(invalid="ignore"):
        return inside & (grid.xyz[..., 1] >= low) & (grid.xyz[..., 1] <= high)


def _found(grid: CloudGrid) -> tuple[list[NDArray[np.bool_]], NDArray[np.bool_]]:
    """Return the surfaces between steps, the largest first, and the points of no piece."""
    from scipy.ndimage import binary_erosion, binary_fill_holes, label

    known, joined = grid.known, links(smoothed(grid, _MEDIAN_HALF), STEP_SIGMAS)
    whole = binary_fill_holes(known)
    along = known[1:] & known[:-1] & ~joined.along
    across = known[:, 1:] & known[:, :-1] & ~joined.across
    for part, broken in (
        (whole[1:], along), (whole[:-1], along), (whole[:, 1:], across), (whole[:, :-1], across),
    ):  # fmt: skip
        part &= ~broken
    # Wide rims close the leaks where noise joins the two sides of a step.
    number, _ = label(binary_erosion(whole, iterations=_RIM, border_value=1))
    sizes = np.bincount(number[known], minlength=2)[1:]
    large = np.argsort(-sizes, kind="stable")
    masks = [number == at + 1 for at in large if sizes[at] >= _PIECE_MIN * known.sum()]
    if not masks:
        raise ArgumentError(
            f"no surface holds {_PIECE_MIN:.0%} of the {np.count_nonzero(known):,} points; "
            "choose regions"
        )
    return masks, known & (number == 0)


def _to_edges(
    grid: CloudGrid, surfaces: tuple[Surface, ...], free: NDArray[np.bool_]
) -> tuple[Surface, ...]:
    """Return surfaces with their rims; between two each point belongs to the nearer plane."""
    from scipy.ndimage import binary_dilation

    rims, nearest = [], np.full(free.shape, np.inf)
    for surface in surfaces:
        grown = binary_dilation(surface.mask, iterations=_TO_EDGE, mask=surface.mask | free)
        rim = np.nonzero(grown & free)
        x, y, z = grid.xyz[rim].T
        plane = surface.plane
        off = np.abs(
            x - plane.centre[0] - (np.column_stack([y, z]) - plane.centre[1:]) @ plane.slopes
        )
        nearest[rim] = np.minimum(nearest[rim], off)
        rims.append((rim, off))
    made = []
    for surface, (rim, off) in zip(surfaces, rims, strict=True):
        mask = surface.mask.copy()
        mask[rim] = off <= nearest[rim]
        made.append(surface._replace(whole=Part.of(grid, mask)))
    return tuple(made)


def _surface(
    grid: CloudGrid, mask: NDArray[np.bool_], common_mm: float | None, name: str
) -> Surface:
    part = Part.of(grid, mask)
    check_part(part, name)
    common = COMMON_SHARE * float(np.median(part.sigma)) if common_mm is None else common_mm
    plane = fit_plane(part, common)
    return Surface(mask, part, plane, flatness(part, plane), common, part)


def _pair(first: Surface, other: Surface, others: Part) -> Pair:
    gap, place = _joint(first.whole, other.whole, others)
    near, near_sigma = first.plane.range_at(*place)
    far, far_sigma = other.plane.range_at(*place)
    cosine = first.plane.cosine
    common_mm = math.hypot(first.common_mm, other.common_mm)
    return Pair(
        _distance(first.part, other.part, common_mm),
        _angle(first.plane, other.plane),
        Value((far - near) * cosine, math.hypot(near_sigma, far_sigma) * cosine),
        gap,
    )


def _distance(first: Part, other: Part, common_mm: float) -> Value:
    """Return the distance of two parallel planes fitted together."""
    both = Part(*(np.concatenate(fields) for fields in zip(first, other, strict=True)))
    second = np.repeat([0.0, 1.0], [len(first.line), len(other.line)])
    middle = np.median(both.xyz[:, 1:], axis=0)
    design = np.column_stack([np.ones_like(second), second, both.xyz[:, 1:] - middle])
    fit = solve(design, both)
    step, slopes = fit.values[1], fit.values[2:]
    cosine = 1.0 / math.sqrt(1.0 + slopes @ slopes)
    gradient = np.array([0.0, cosine, *(-step * slopes * cosine**3)])
    # The shared error of the slopes acts over the distance from one surface to the other.
    apart = np.median(other.xyz[:, 1:], axis=0) - np.median(first.xyz[:, 1:], axis=0)
    lever = apart / extent_mm(both.xyz[:, 1:])
    variance = float(gradient @ fit.covariance @ gradient)
    variance += (common_mm * cosine) ** 2 * (1.0 + float(lever @ lever))
    return Value(float(step) * cosine, math.sqrt(variance))


def _angle(first: Plane, other: Plane) -> Value:
    """Return the angle between two planes; its sigma is that of tilts about their common line."""
    one, two = first.normal, other.normal
    line = np.cross(one, two)
    sine = float(np.linalg.norm(line))
    # Parallel planes have no common line: any across the range.
    axis = line / sine if sine > 0.0 else np.array([0.0, 0.0, 1.0])
    variance = 0.0
    for plane, normal in ((first, one), (other, two)):
        # Each normal turns by its own cosine, a steep one by little.
        turn = -np.cross(axis, normal)[1:] * plane.cosine
        variance += float(turn @ plane.covariance[1:, 1:] @ turn)
    return Value(
        math.degrees(math.atan2(sine, float(one @ two))), math.degrees(math.sqrt(variance))
    )


def _joint(first: Part, other: Part, others: Part) -> tuple[Value, tuple[float, float]]:
    """Return the gap between the facing edges, and y and z of the middle between them.

    There is none where points of ``others``, outside the chosen regions, are between.
    """
    ends = [np.quantile(part.xyz[:, 1:], (0.0, 1.0), axis=0) for part in (first, other)]
    spaces = np.maximum(ends[1][0] - ends[0][1], ends[0][0] - ends[1][1])
    axis = int(np.argmax(spaces))
    after = ends[1][0, axis] + ends[1][1, axis] >= ends[0][0, axis] + ends[0][1, axis]
    low, high = (first, other) if after else (other, first)
    across = ("line", "column")[1 - axis]
    edges, pitch = _edges(low, high, axis, across)
    middle = np.array([np.median(np.concatenate([ends[0][:, k], ends[1][:, k]])) for k in (0, 1)])
    if not len(edges):
        return Value(math.nan, math.nan), (float(middle[0]), float(middle[1]))
    middle[axis] = float(np.median(edges.mean(axis=1)))
    space = edges[:, 1] - edges[:, 0]
    value = float(space.mean()) - pitch
    # An edge is anywhere within one pitch behind the last point.
    sigma = math.sqrt(float(space.var()) / len(space) + pitch**2 / 6.0)
    ends_mm = np.median(edges, axis=0) + np.array([pitch, -pitch])
    rows = getattr(others, across)
    between = (others.xyz[:, 1 + axis] > ends_mm[0]) & (others.xyz[:, 1 + axis] < ends_mm[1])
    ours = getattr(first, across)
    between &= (rows >= ours.min()) & (rows <= ours.max())
    filled = np.count_nonzero(between) > len(edges)
    gap = Value(value, sigma) if value > -pitch and not filled else Value(math.nan, math.nan)
    return gap, (float(middle[0]), float(middle[1]))


def _edges(low: Part, high: Part, axis: int, across: str) -> tuple[Array, float]:
    """Return the last place of ``low`` and the first of ``high`` in each row, and the pitch."""
    rows, columns = (getattr(part, across) for part in (low, high))
    count = int(max(rows.max(), columns.max())) + 1
    last, first = np.full(count, -np.inf), np.full(count, np.inf)
    np.maximum.at(last, rows, low.xyz[:, 1 + axis])
    np.minimum.at(first, columns, high.xyz[:, 1 + axis])
    edges = np.column_stack([last, first])[np.isfinite(last) & np.isfinite(first)]
    order = np.lexsort((low.xyz[:, 1 + axis], rows))
    steps = np.diff(low.xyz[order, 1 + axis])[np.diff(rows[order]) == 0]
    return edges, float(np.median(steps)) if len(steps) else 0.0
