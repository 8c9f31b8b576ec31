"""A scan as a moving picture: the cloud grows behind the laser line, then turns."""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import atomic_write
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.report.accuracy import stage_and_range_mm
from eschorty_ros.report.figures import central, grid_of, image_of

GROWING_FRAMES, TURNING_FRAMES = 44, 20
FRAME_MS = 70
SIDE_PX = 440
TURN_DEG = 32.0
PITCH_DEG = 8.0
LINE_PROFILES = 3
COLOURS = 96
_BACKGROUND = (16, 18, 24)
_LASER = (255, 60, 40)
_LIGHT, _AMBIENT = (-0.83, 0.26, 0.49), 0.3
# Neighbours in profiles and columns over which a surface's slope is taken.
_SMOOTH = (2.0, 4.0)


class _Surface(NamedTuple):
    """Places in mm from the middle, colours 0 to 255, and profile of each point."""

    xyz: NDArray[np.float64]
    colour: NDArray[np.uint8]
    profile: NDArray[np.int64]


def write_growing_scan(
    points: NDArray[np.void], path: str | os.PathLike[str], progress: Progress
) -> None:
    """Write a GIF of the cloud: profile by profile as the stage moves, then from both sides.

    - ``points``: POINT_DTYPE, shape (n,).
    - ``path``: Ends in ``.gif``.

    Raises ``ArgumentError`` when the cloud has less than two profiles or columns, or the path
    cannot be written.
    """
    from PIL import Image

    surface = _surface(points)
    last = int(surface.profile.max())
    views: list[tuple[int | None, float]] = [
        (round(last * share), TURN_DEG * (share - 1.0) * 0.5)
        for share in np.linspace(0.0, 1.0, GROWING_FRAMES)
    ]
    phase = np.linspace(0.0, 2.0 * np.pi, TURNING_FRAMES, endpoint=False)
    views += [(None, TURN_DEG * np.sin(angle)) for angle in phase]
    images = []
    for view in views:
        images.append(Image.fromarray(_frame(surface, *view)))
        progress(len(images) / len(views), "")
    # One palette for all frames: that of a frame with every colour.
    palette = images[GROWING_FRAMES * 3 // 4].quantize(COLOURS)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    with atomic_write(path) as stream:
        first.save(
            stream, "gif", save_all=True, append_images=others, duration=FRAME_MS, loop=0,
            optimize=True,
        )  # fmt: skip


def _surface(points: NDArray[np.void]) -> _Surface:
    from matplotlib import colormaps

    stage_mm, range_mm = stage_and_range_mm(points)
    grid = grid_of(points, stage_mm)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64) * 1e3
    low, high = central(range_mm)
    near = (high - range_mm) / (high - low)
    shown = (near >= 0.0) & (near <= 1.0)
    images = [image_of(grid, points, values) for values in xyz.T]
    if min(images[0].shape) < 2:
        raise ArgumentError("a growing scan needs two profiles and two columns or more; give them")
    light = _light(np.stack(images))[grid.profile, points["column"]]
    colour = colormaps["viridis"](0.15 + 0.85 * near)[:, :3] * light[:, None]
    xyz -= 0.5 * (xyz[shown].min(axis=0) + xyz[shown].max(axis=0))
    return _Surface(xyz[shown], (255.0 * colour[shown]).astype(np.uint8), grid.profile[shown])


def _light(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the brightness of a matt surface, of points (3, profiles, columns) in mm."""
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(xyz[0])
    weight = np.maximum(gaussian_filter(known.astype(np.float64), _SMOOTH), 1e-6)
    smooth = [gaussian_filter(np.where(known, part, 0.0), _SMOOTH) / weight for part in xyz]
    along, across = (np.stack([np.gradient(part, axis=k) for part in smooth]) for k in (0, 1))
    normal = np.cross(along, across, axis=0)
    normal *= -np.sign(normal[0])
    cosine = np.tensordot(_LIGHT, normal, 1) / np.maximum(np.linalg.norm(normal, axis=0), 1e-9)
    return np.asarray(_AMBIENT + (1.0 - _AMBIENT) * np.clip(cosine, 0.0, 1.0))


def _frame(surface: _Surface, newest: int | None, turn_deg: float) -> NDArray[np.uint8]:
    """Return a picture (rows, columns, 3) of the profiles up to ``newest``, turned about z."""
    turn, pitch = np.radians(turn_deg), np.radians(PITCH_DEG)
    x, y, z = surface.xyz.T
    depth, right = np.cos(turn) * x - np.sin(turn) * y, -np.sin(turn) * x - np.cos(turn) * y
    up, depth = np.cos(pitch) * z - np.sin(pitch) * depth, np.cos(pitch) * depth
    scale = 0.9 * SIDE_PX / max(np.ptp(y), np.ptp(z), 1e-3)
    picture = np.full((SIDE_PX, SIDE_PX, 3), _BACKGROUND, np.uint8)
    order = np.argsort(-depth)
    colour = surface.colour
    if newest is not None:
        order = order[surface.profile[order] <= newest]
        lit = surface.profile > newest - LINE_PROFILES
        colour = np.where(lit[:, None], np.array(_LASER, np.uint8), colour)
    column = (SIDE_PX / 2 + scale * right[order]).astype(np.intp)
    row = (SIDE_PX / 2 - scale * up[order]).astype(np.intp)
    for down, aside in ((0, 0), (0, 1), (1, 0), (1, 1)):
        at = np.clip(row + down, 0, SIDE_PX - 1), np.clip(column + aside, 0, SIDE_PX - 1)
        picture[at] = colour[order]
    return picture
