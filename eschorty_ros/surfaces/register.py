"""Clouds of several passes or poses in one frame: ICP with the points' own sigmas as weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import SIGMA_PER_MAD, positive
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.storage import join_points
from eschorty_ros.simulation.scenes import load_open3d
from eschorty_ros.surfaces.grid import organise
from eschorty_ros.surfaces.plane import (
    COMMON_SHARE,
    CUT_SIGMA,
    Part,
    clustered_covariance,
    extent_mm,
)
from eschorty_ros.surfaces.profiles import period_s

if TYPE_CHECKING:
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import cKDTree

POINTS_MAX = 60_000
_PAIRS_MIN = 200
_ROUNDS, _ITERATIONS = 4, 15
_CONVERGED_SIGMAS = 0.01
# Neighbours of a normal; its noise must not look like the relief of the surface.
_NORMAL_NEIGHBOURS = 150
# Of the noise alone, of which surfaces that slide or turn show 0.8 to 2.5.
_RELIEF_MIN = 10.0
# Scans that fit show 0.5 to 1.0 sigma, one recording with other settings 0.4, and one cloud twice
# 0.2; those that stopped at a wrong pose show 2.3 to 10.
POOR_SIGMAS = 2.0
GOOD_SIGMAS = 0.45
_PERIODS_APART = 10
_WITHOUT_PERIOD_S = 1.0


class Pose(NamedTuple):
    """Pose of a cloud in the frame of the first one, with its covariance."""

    transform: Array
    """Shape (4, 4). Takes points of the cloud, in m, into the frame of the first one."""
    centre_mm: Array
    """Shape (3,). Middle of the overlap, about which the small rotations of the covariance turn."""
    covariance: Array
    """Shape (6, 6). Of the rotation about x, y, z (rad) and of the translation along x, y, z
    (mm)."""
    pairs: int
    """Points on the first cloud's surface."""
    overlap: float
    """Share of the points within reach of it."""
    rms_sigmas: float
    """Root mean square distance of the points along the normal over its own sigma."""

    @property
    def rotation_deg(self) -> Array:
        """Return the rotation vector, degrees."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(self.transform[:3, :3]).as_rotvec()
        return np.asarray(np.degrees(turn))

    @property
    def shift_mm(self) -> Array:
        """Return by how much the middle of the overlap moves, mm."""
        moved = self.transform[:3, :3].T @ (self.centre_mm - self.transform[:3, 3] * 1e3)
        return np.asarray(self.centre_mm - moved)

    @property
    def sigmas(self) -> Array:
        """Return the standard deviations of rotation (degrees) and shift (mm), shape (6,)."""
        spread = np.sqrt(np.diag(self.covariance))
        return np.concatenate([np.degrees(spread[:3]), spread[3:]])


class _Shape(NamedTuple):
    """Points for ICP, in mm from an origin, and the normals there."""

    part: Part
    normals: Array
    inside: NDArray[np.bool_]
    """Whether there are points all around: normals at a rim are those of one side."""


class _Surface(NamedTuple):
    """The first cloud's points over y and z: a tree of them, and x, normal, sigma between them."""

    places: cKDTree
    between: LinearNDInterpolator
    inside: NDArray[np.bool_]


class _Pairs(NamedTuple):
    """Points of the other cloud on the first one's surface, as a linear fit of a pose."""

    ours: NDArray[np.int64]
    """Shape (n,). Index of the point."""
    moved: Array
    """Shape (n, 3). Its place in the frame of the first cloud, mm."""
    design: Array
    """Shape (n, 6). Derivatives of the residual by a small rotation about `centre` and a shift."""
    residual: Array
    sigma: Array
    """Shape (n,). Distance along the normal, and its standard deviation, mm."""
    centre: Array
    normal_noise: float
    """Standard deviation of a component of the normals."""
    overlap: float


def register(
    first: NDArray[np.void],
    other: NDArray[np.void],
    start: Array | None = None,
    reach_mm: float = 10.0,
    progress: Progress | None = None,
) -> Pose:
    """Return the pose of ``other`` in the frame of ``first``.

    ICP along the mean normal of both clouds (Rusinkiewicz, "A symmetric objective function for
    ICP", ACM Trans. Graph. 38, 2019), weighted with the points' own sigmas.

    - ``first``, ``other``: POINT_DTYPE.
    - ``start``: Shape (4, 4). First guess, metres.
    - ``reach_mm``: Farthest from the surface in the first round; each further round halves it.

    Raises ``ArgumentError`` when the clouds do not overlap, or slide or turn on each other. Raises
    ``EschortyError`` without Open3D.
    """
    positive("reach_mm", reach_mm)
    open3d = load_open3d("registration")
    origin = np.array([np.median(first[axis]) for axis in "xyz"], np.float64) * 1e3
    target, source = (_shape(open3d, points, origin) for points in (first, other))
    surface = _surface(target)
    transform = _about(np.eye(4) if start is None else start, origin)
    reach = reach_mm
    for number in range(_ROUNDS):
        if progress is not None:
            progress(number / _ROUNDS, "")
        for _ in range(_ITERATIONS):
            pairs = _paired(surface, source, transform, reach)
            scaled = pairs.design / pairs.sigma[:, None]
            step = np.linalg.lstsq(scaled, -pairs.residual / pairs.sigma, rcond=None)[0]
            transform = _moved(transform, np.asarray(step, np.float64), pairs.centre)
            if np.linalg.norm(scaled @ step) < _CONVERGED_SIGMAS:
                break
        reach *= 0.5
    return _pose(source, transform, pairs, origin)


def join(first: NDArray[np.void], other: NDArray[np.void], pose: Pose) -> NDArray[np.void]:
    """Return both clouds in the frame of the first, the times of the other one following."""
    moved = other.copy()
    xyz = np.stack([other[axis] for axis in "xyz"], axis=1).astype(np.float64)
    xyz = xyz @ pose.transform[:3, :3].T + pose.transform[:3, 3]
    for k, axis in enumerate("xyz"):
        moved[axis] = xyz[:, k]
    period = period_s(first)
    if period > 0.0:
        # Periods of both on one grid, so that the joined cloud still has one.
        ours, theirs = (np.exp(2j * np.pi * part["t"] / period).mean() for part in (first, other))
        shift = period * float(np.angle(ours / theirs)) / (2.0 * math.pi)
        wait = first["t"].max() - other["t"].min() - shift
        moved["t"] += shift + period * (math.ceil(wait / period) + _PERIODS_APART)
    else:
        moved["t"] += first["t"].max() - other["t"].min() + _WITHOUT_PERIOD_S
    return join_points([first, moved])


def pose_matrix(values: Sequence[float]) -> Array:
    """Return the transform, in m, of a shift in mm and a rotation vector in degrees: x y z each."""
    from scipy.spatial.transform import Rotation

    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(np.radians(values[3:])).as_matrix()
    moved[:3, 3] = np.asarray(values[:3]) * 1e-3
    return moved


def _about(transform: Array, origin_mm: Array) -> Array:
    """Return a transform of metres as one of mm from an origin."""
    moved = np.array(transform, np.float64)
    moved[:3, 3] = moved[:3, 3] * 1e3 + moved[:3, :3] @ origin_mm - origin_mm
    return moved


def _moved(transform: Array, step: Array, centre: Array) -> Array:
    """Return a transform followed by a rotation (rad) about a centre and a shift."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    moved = transform.copy()
    moved[:3, :3] = turn @ transform[:3, :3]
    moved[:3, 3] = turn @ (transform[:3, 3] - centre) + centre + step[3:]
    return moved


def _shape(open3d: Any, points: NDArray[np.void], origin_mm: Array) -> _Shape:
    part = Part.of(grid := organise(points), grid.known)
    part = part.select(slice(None, None, math.ceil(len(part.line) / POINTS_MAX)))
    part = part._replace(xyz=part.xyz - origin_mm)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(part.xyz))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    return _Shape(part, normals * -np.sign(normals[:, :1]), _inside(part.xyz[:, 1:]))


def _inside(places: Array) -> NDArray[np.bool_]:
    """Return whether a point's neighbours are all around it, shape (n,).

    - ``places``: Shape (n, 2), mm.
    """
    from scipy.ndimage import binary_closing, binary_erosion

    low, extent = places.min(axis=0), np.ptp(places, axis=0)
    # A line has as many cells as points, too.
    extent = np.maximum(extent, max(extent.max() / len(places), 1e-9))
    radius_mm = math.sqrt(_NORMAL_NEIGHBOURS * extent[0] * extent[1] / (math.pi * len(places)))
    # Three cells to the radius, in a margin that neither step reaches.
    cell = np.floor((places - low) / radius_mm * 3.0).astype(np.intp) + 4
    held = np.zeros(cell.max(axis=0) + 5, np.bool_)
    held[tuple(cell.T)] = True
    around = np.ones((3, 3), np.bool_)
    held = binary_erosion(binary_closing(held, around), around, iterations=3)
    return np.asarray(held[tuple(cell.T)])


def _surface(shape: _Shape) -> _Surface:
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError, cKDTree

    part = shape.part
    values = np.column_stack([part.xyz[:, 0], shape.normals, part.sigma])
    try:
        between = LinearNDInterpolator(part.xyz[:, 1:], values)
    except QhullError as error:
        raise ArgumentError("the first cloud is a line; give a cloud of a sweep") from error
    return _Surface(cKDTree(part.xyz[:, 1:]), between, shape.inside)


def _paired(surface: _Surface, source: _Shape, transform: Array, reach_mm: float) -> _Pairs:
    """Return the points within reach of the surface, outliers left out.

    They meet it at their own y and z. The nearest point in space would be one of a similar error of
    the range, and any point instead of a place draws the clouds onto each other's grid.
    """
    turn = transform[:3, :3]
    moved = source.part.xyz @ turn.T + transform[:3, 3]
    aside, nearest = surface.places.query(moved[:, 1:], distance_upper_bound=reach_mm)
    ours = np.flatnonzero(np.isfinite(aside))
    fixed = surface.between(moved[ours, 1:])
    inside = np.isfinite(fixed[:, 0])
    ours, fixed = ours[inside], fixed[inside]
    moved, around = moved[ours], source.inside[ours] & surface.inside[nearest[ours]]
    turned, normals = source.normals[ours] @ turn.T, fixed[:, 1:4]
    turned *= np.sign(np.sum(turned * normals, axis=1))[:, None]
    difference = np.abs(turned - normals)[:, 1:]
    normals = normals + turned
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    residual = normals[:, 0] * (moved[:, 0] - fixed[:, 0])
    sigma = np.hypot(fixed[:, 4] * normals[:, 0], source.part.sigma[ours] * (normals @ turn[:, 0]))
    # Cut along the normal, and not within the noise: else the cut itself holds the points.
    near = np.abs(residual) <= np.maximum(reach_mm, CUT_SIGMA * sigma)
    found = np.count_nonzero(near)
    if found < _PAIRS_MIN:
        raise ArgumentError(
            f"{found:,} points of the clouds are within {reach_mm:g} mm; give clouds that "
            "overlap, a start nearer to it, or a wider reach"
        )
    # The normals of one place in both clouds differ by their noise; half of it is in their mean.
    noise = SIGMA_PER_MAD * float(np.median(difference[near])) / 2.0
    ratio = np.abs(residual) / sigma
    near &= ratio <= CUT_SIGMA * max(SIGMA_PER_MAD * float(np.median(ratio[near])), 1.0)
    # The normals of a rim hold a cloud where its surface would let it slide.
    if np.count_nonzero(near & around) >= _PAIRS_MIN:
        near &= around
    ours, moved, normals, residual, sigma = (
        v[near] for v in (ours, moved, normals, residual, sigma)
    )
    centre = moved.mean(axis=0)
    design = np.column_stack([np.cross(moved - centre, normals), normals])
    overlap = found / len(source.part.line)
    return _Pairs(ours, moved, design, residual, sigma, centre, noise, overlap)


def _pose(source: _Shape, transform: Array, pairs: _Pairs, origin_mm: Array) -> Pose:
    rms_sigmas = float(np.sqrt(np.mean((pairs.residual / pairs.sigma) ** 2)))
    _refuse_sliding(pairs, rms_sigmas)
    line, column = source.part.line[pairs.ours], source.part.column[pairs.ours]
    part = Part(line, column, pairs.moved, pairs.sigma)
    covariance = clustered_covariance(pairs.design, pairs.residual, part)
    common = COMMON_SHARE * float(np.median(pairs.sigma))
    extent = extent_mm(pairs.moved)
    shared = np.array([0.0, common / extent[2], common / extent[1], common, 0.0, 0.0])
    covariance += np.diag(shared**2)
    metres = transform.copy()
    metres[:3, 3] = (transform[:3, 3] + origin_mm - transform[:3, :3] @ origin_mm) * 1e-3
    return Pose(
        metres, pairs.centre + origin_mm, covariance, len(pairs.ours), pairs.overlap, rms_sigmas
    )


def _refuse_sliding(pairs: _Pairs, rms_sigmas: float) -> None:
    """Refuse surfaces on which the clouds slide or turn: their relief is noise of the normals.

    At a wrong pose the normals differ as if they were noise.
    """
    design, sigma = pairs.design, pairs.sigma
    size = float(np.sqrt(np.mean(np.sum(design[:, :3] ** 2, axis=1)) / 2.0)) or 1.0
    scaled = design / np.array([size, size, size, 1.0, 1.0, 1.0]) / sigma[:, None]
    least, axes = np.linalg.eigh(scaled.T @ scaled)
    if least[0] < _RELIEF_MIN * pairs.normal_noise**2 * float(np.sum(sigma**-2.0)):
        if rms_sigmas > POOR_SIGMAS:
            raise ArgumentError(
                f"the clouds do not fit: {pairs.overlap:.0%} of the points overlap, "
                f"{rms_sigmas:.1f} sigma from the first cloud; give a start nearer to the pose, "
                "or a wider reach"
            )
        loose = int(np.argmax(np.abs(axes[:, 0])))
        name = ("turns about x", "turns about y", "turns about z", "slides along x",
                "slides along y", "slides along z")[loose]  # fmt: skip
        raise ArgumentError(
            f"the cloud {name} on the first one without a difference; give clouds with relief "
            "in every direction"
        )
