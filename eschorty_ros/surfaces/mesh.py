"""A triangle mesh of a cloud's organised grid, with as few vertices as the points' errors allow."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import folder_beside
from eschorty_ros.core.base.numbers import file_path, positive
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.simulation.scenes import load_open3d
from eschorty_ros.surfaces.grid import STEP_SIGMAS, CloudGrid, Links, links, organise, smoothed
from eschorty_ros.surfaces.plane import POINTS_MIN, check_extent

FORMATS = (".ply", ".obj", ".stl")
_WITHIN = 0.95
_LEVELS_MAX = 24
_TRIANGLES_MIN = 64
_SMOOTH_HALF = 2
# A step of less than this over the distance of two neighbours is a slope as well.
_STEEPNESS = 2.0


class Level(NamedTuple):
    """One step of the decimation."""

    vertices: int
    triangles: int
    error_mm: float
    """Distance to the mesh within which 95 % of the cloud's points are."""
    error_sigmas: float
    """The same as a multiple of each point's own sigma."""
    lost: int
    """Largest group of neighbouring points beyond 5 sigma of its range, within for the finest."""


class Mesh(NamedTuple):
    """The coarsest mesh within the errors."""

    vertices: Array
    """Shape (n, 3), mm."""
    triangles: NDArray[np.int64]
    """Shape (m, 3). Their front faces the sensor."""
    levels: tuple[Level, ...]
    """From the finest to the first one that is too coarse."""
    chosen: int
    """Index of the mesh's level."""
    points: int
    """Points of the cloud that the finest mesh holds."""


def mesh(points: NDArray[np.void], sigmas: float = 2.0, progress: Progress | None = None) -> Mesh:
    """Return the coarsest mesh from which 95 % of the points are within ``sigmas`` of their own.

    The finest mesh joins neighbours of the grid, at the median range of 5 by 5; none over a step
    of the range. Each further level has half the triangles (Garland and Heckbert's quadrics). A
    level that loses points enough for a surface, such as those of a post, is too coarse.

    - ``points``: POINT_DTYPE, shape (n,).
    - ``sigmas``: Gaussian errors alone need 1.96.

    Raises ``ArgumentError`` when the cloud is no sweep, or the finest mesh is beyond the errors.
    Raises ``EschortyError`` without Open3D.
    """
    positive("sigmas", sigmas)
    open3d = load_open3d("a mesh")
    grid = organise(points)
    smooth = smoothed(grid, _SMOOTH_HALF)
    triangles = _triangles(smooth, links(smooth, STEP_SIGMAS, _STEEPNESS))
    if not len(triangles):
        raise ArgumentError("no three neighbouring points are on one surface; give another cloud")
    used = np.unique(triangles)
    place = np.full(grid.point.size, -1, np.int64)
    place[used] = np.arange(len(used))
    measured = grid.xyz.reshape(-1, 3)[used], grid.sigma.ravel()[used]
    check_extent(measured[0], "the cloud")
    shape = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(smooth.xyz.reshape(-1, 3)[used]),
        open3d.utility.Vector3iVector(place[triangles].astype(np.int32)),
    )
    finest = len(shape.triangles)
    first, held = _level(open3d, shape, *measured)
    levels = [first]
    if levels[0].error_sigmas > sigmas:
        raise ArgumentError(
            f"sigmas is {sigmas:g} and the finest mesh is {levels[0].error_sigmas:.2f} sigma from "
            "its points; allow more"
        )
    chosen, last = shape, 0
    while len(levels) < _LEVELS_MAX and levels[-1].triangles > _TRIANGLES_MIN:
        if progress is not None:
            halvings = [math.log2(finest / n) for n in (levels[-1].triangles, _TRIANGLES_MIN)]
            progress(halvings[0] / halvings[1], f"{levels[-1].triangles:,} triangles")
        coarser = chosen.simplify_quadric_decimation(levels[-1].triangles // 2)
        if not 0 < len(coarser.triangles) < levels[-1].triangles:
            break
        level, near = _level(open3d, coarser, *measured)
        level = level._replace(lost=_largest(grid.point.shape, used[held & ~near]))
        levels.append(level)
        if level.error_sigmas > sigmas or level.lost >= POINTS_MIN:
            break
        chosen, last = coarser, len(levels) - 1
    return Mesh(
        np.asarray(chosen.vertices),
        np.asarray(chosen.triangles).astype(np.int64),
        tuple(levels),
        last,
        len(used),
    )


def write_mesh(path: str | os.PathLike[str], made: Mesh) -> None:
    """Write a mesh in metres as ``.ply``, ``.obj`` or ``.stl``; it appears complete or not at all.

    Raises ``ArgumentError`` for another extension, or a path that cannot be written.
    """
    target = check_format(path)
    open3d = load_open3d("a mesh")
    shape = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(made.vertices * 1e-3),
        open3d.utility.Vector3iVector(made.triangles.astype(np.int32)),
    )
    shape.compute_vertex_normals()
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    with folder_beside(target) as folder:
        part = folder / f"mesh{target.suffix.lower()}"
        if not open3d.io.write_triangle_mesh(str(part), shape):
            raise ArgumentError(f"cannot write {target}; check folder and disk")
        part.replace(target)


def check_format(path: str | os.PathLike[str]) -> Path:
    """Return the path of a mesh; another extension than those of ``FORMATS`` is refused."""
    target = file_path("path", path)
    if target.suffix.lower() not in FORMATS:
        raise ArgumentError(f"{target} ends in {target.suffix!r}; choose {', '.join(FORMATS)}")
    return target


def _triangles(grid: CloudGrid, joined: Links) -> NDArray[np.int64]:
    """Return the triangles between neighbouring cells, as flat indices, their front to the sensor.

    Four cells on one surface make two triangles, three make one.
    """
    cell = np.arange(grid.point.size).reshape(grid.point.shape)
    corner = cell[:-1, :-1], cell[:-1, 1:], cell[1:, 1:], cell[1:, :-1]
    side = joined.across[:-1], joined.along[:, 1:], joined.across[1:], joined.along[:, :-1]
    whole = np.logical_and.reduce(side)
    parts = [np.column_stack([corner[k][whole] for k in three]) for three in ((0, 1, 2), (0, 2, 3))]
    free = ~whole
    for k in range(4):
        # The corner k with the sides before and after it.
        single = free & side[k - 1] & side[k]
        free &= ~single
        parts.append(np.column_stack([corner[at % 4][single] for at in (k - 1, k, k + 1)]))
    triangles = np.concatenate(parts)
    xyz = grid.xyz.reshape(-1, 3)[triangles]
    normal_x = np.cross(xyz[:, 1] - xyz[:, 0], xyz[:, 2] - xyz[:, 0])[:, 0]
    return triangles if normal_x.sum() <= 0.0 else triangles[:, ::-1]


def _largest(shape: tuple[int, ...], cells: NDArray[np.int64]) -> int:
    """Return the number of cells, of flat indices, in the largest group of neighbours."""
    from scipy.ndimage import label

    inside = np.zeros(shape, bool)
    inside.ravel()[cells] = True
    groups, _ = label(inside, np.ones((3, 3)))
    return int(np.bincount(groups[inside], minlength=1).max())


def _level(open3d: Any, shape: Any, xyz: Array, sigma: Array) -> tuple[Level, NDArray[np.bool_]]:
    """Return a level, none lost, and which points are within 5 sigma of its range."""
    # Its single precision has its digits near the origin.
    middle = xyz.mean(axis=0)
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        (np.asarray(shape.vertices) - middle).astype(np.float32),
        np.asarray(shape.triangles).astype(np.uint32),
    )
    points = (xyz - middle).astype(np.float32)
    off = scene.compute_closest_points(points, nthreads=1)["points"].numpy() - points
    distance = np.linalg.norm(off, axis=1)
    # The range alone: edges that retreat are no lost relief.
    near = np.abs(off[:, 0]) <= STEP_SIGMAS * sigma
    level = Level(
        len(shape.vertices),
        len(shape.triangles),
        float(np.quantile(distance, _WITHIN)),
        float(np.quantile(distance / sigma, _WITHIN)),
        0,
    )
    return level, near
