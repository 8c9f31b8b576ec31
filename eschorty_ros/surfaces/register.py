"""Clouds of several passes or poses in one frame: ICP with the points' own sigmas as weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array, positive
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.storage import join_points
from eschorty_ros.simulation.scenes import load_open3d
from eschorty_ros.surfaces.grid import organise
from eschorty_ros.surfaces.plane import COMMON_SHARE, MAD, Part, clustered_covariance
from eschorty_ros.surfaces.profiles import period_s

POINTS_MAX = 60_000
_PAIRS_MIN = 200
_ROUNDS, _ITERATIONS = 4, 60
# Neighbours of a normal; its noise must not look like the relief of the surface.
_NORMAL_NEIGHBOURS = 150
_RELIEF_MIN = 4.0
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
    """Points with a partner."""
    overlap: float
    """Share of the points with a partner."""
    rms_sigmas: float
    """Root mean square distance of the pairs along the normal over its own sigma."""

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
    """Points for ICP: Open3D's cloud in mm from an origin, their grid's cells, normals."""

    cloud: Any
    part: Part
    normals: Array


def register(
    first: NDArray[np.void],
    other: NDArray[np.void],
    start: Array | None = None,
    reach_mm: float = 10.0,
) -> Pose:
    """Return the pose of ``other`` in the frame of ``first``.

    Generalised ICP (Segal, Haehnel and Thrun, 2009) with the covariance of each point: its own
    sigma along the range, free along the surface.

    - ``first``, ``other``: POINT_DTYPE.
    - ``start``: Shape (4, 4). First guess, metres.
    - ``reach_mm``: Farthest partner of the first round; each further round halves it.

    Raises ``ArgumentError`` when the clouds do not overlap, or slide or turn on each other. Raises
    ``EschortyError`` without Open3D.
    """
    positive("reach_mm", reach_mm)
    open3d = load_open3d("registration")
    origin = np.array([np.median(first[axis]) for axis in "xyz"], np.float64) * 1e3
    target, source = (_shape(open3d, points, origin) for points in (first, other))
    transform = _about(np.eye(4) if start is None else start, origin)
    methods = open3d.pipelines.registration
    criteria = methods.ICPConvergenceCriteria(max_iteration=_ITERATIONS)
    reach = reach_mm
    for _ in range(_ROUNDS):
        result = methods.registration_generalized_icp(
            source.cloud, target.cloud, reach, transform,
            methods.TransformationEstimationForGeneralizedICP(), criteria,
        )  # fmt: skip
        if len(result.correspondence_set) < _PAIRS_MIN:
            raise ArgumentError(
                f"{len(result.correspondence_set):,} points of the clouds are within {reach:g} mm; "
                "give clouds that overlap, a start nearer to it, or a wider reach"
            )
        transform = np.asarray(result.transformation)
        reach *= 0.5
    return _pose(target, source, transform, np.asarray(result.correspondence_set), origin)


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


def _shape(open3d: Any, points: NDArray[np.void], origin_mm: Array) -> _Shape:
    part = Part.of(grid := organise(points), grid.known)
    keep = slice(None, None, math.ceil(len(part.line) / POINTS_MAX))
    part = part.select(keep)
    xyz = part.xyz - origin_mm
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    normals *= -np.sign(normals[:, :1])
    # The radius of that many neighbours on an area.
    area = np.ptp(xyz[:, 1]) * np.ptp(xyz[:, 2]) / len(xyz)
    radius = math.sqrt(_NORMAL_NEIGHBOURS * area / math.pi)
    along = np.maximum(np.abs(normals[:, 0]) * part.sigma, 1e-3 * part.sigma)
    # Free along the surface: far beyond both sigma and spacing.
    free = (3.0 * radius) ** 2
    outer = np.einsum("ni,nj->nij", normals, normals)
    spread = free * (np.eye(3) - outer) + (along**2)[:, None, None] * outer
    cloud.covariances = open3d.utility.Matrix3dVector(spread)
    return _Shape(cloud, part, normals)


def _pose(
    target: _Shape, source: _Shape, transform: Array, pairs: NDArray[np.int64], origin_mm: Array
) -> Pose:
    ours, theirs = pairs[:, 0], pairs[:, 1]
    turn = transform[:3, :3]
    moved = np.asarray(source.cloud.points)[ours] @ turn.T + transform[:3, 3]
    fixed = np.asarray(target.cloud.points)[theirs]
    turned = source.normals[ours] @ turn.T
    normals = target.normals[theirs]
    turned *= np.sign(np.sum(turned * normals, axis=1))[:, None]
    # The normals of one place in both clouds differ by their noise; half of it is in their mean.
    noise = MAD * float(np.median(np.abs(turned - normals)[:, 1:])) / 2.0
    normals = normals + turned
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    residual = np.sum(normals * (moved - fixed), axis=1)
    range_axis = turn[:, 0]
    sigma = np.hypot(
        target.part.sigma[theirs] * normals[:, 0], source.part.sigma[ours] * (normals @ range_axis)
    )
    near = np.abs(residual) <= 4.0 * np.sqrt(np.mean((residual / sigma) ** 2)) * sigma
    moved, normals, residual, sigma = (v[near] for v in (moved, normals, residual, sigma))
    ours = ours[near]
    centre = moved.mean(axis=0)
    design = np.column_stack([np.cross(moved - centre, normals), normals])
    _refuse_sliding(design, sigma, noise)
    part = Part(source.part.line[ours], source.part.column[ours], moved, sigma)
    covariance = clustered_covariance(design, residual, part)
    common = COMMON_SHARE * float(np.median(sigma))
    extent = np.ptp(moved, axis=0)
    shared = np.array([0.0, common / extent[2], common / extent[1], common, 0.0, 0.0])
    covariance += np.diag(shared**2)
    metres = transform.copy()
    metres[:3, 3] = (transform[:3, 3] + origin_mm - turn @ origin_mm) * 1e-3
    return Pose(
        metres,
        centre + origin_mm,
        covariance,
        len(ours),
        len(pairs) / len(source.part.line),
        float(np.sqrt(np.mean((residual / sigma) ** 2))),
    )


def _refuse_sliding(design: Array, sigma: Array, normal_noise: float) -> None:
    """Refuse surfaces on which the clouds slide or turn: their relief is noise of the normals."""
    size = float(np.sqrt(np.mean(np.sum(design[:, :3] ** 2, axis=1)) / 2.0)) or 1.0
    scaled = design / np.array([size, size, size, 1.0, 1.0, 1.0]) / sigma[:, None]
    least, axes = np.linalg.eigh(scaled.T @ scaled)
    if least[0] < _RELIEF_MIN * normal_noise**2 * float(np.sum(sigma**-2.0)):
        loose = int(np.argmax(np.abs(axes[:, 0])))
        name = ("turns about x", "turns about y", "turns about z", "slides along x",
                "slides along y", "slides along z")[loose]  # fmt: skip
        raise ArgumentError(
            f"the cloud {name} on the first one without a difference; give clouds with relief "
            "in every direction"
        )
