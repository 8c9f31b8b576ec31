"""Clouds on a regular grid, of any surface."""

import numpy as np

from eschorty_ros.core.storage import POINT_DTYPE

PITCH_Y, PITCH_Z = 0.7, 0.25


def cloud(range_mm, sigma_mm=0.17, smooth=17, seed=1):
    """A cloud of 60 lines and 400 columns; errors of ``smooth`` neighbouring columns are alike."""
    rng = np.random.default_rng(seed)
    line, column = np.mgrid[0:60, 0:400]
    y, z = line * PITCH_Y, (column - 200) * PITCH_Z
    noise = rng.normal(0.0, sigma_mm * np.sqrt(smooth), (60, 400 + smooth - 1))
    error = np.lib.stride_tricks.sliding_window_view(noise, smooth, axis=1).mean(axis=-1)
    x = np.broadcast_to(range_mm(y, z), y.shape) + error
    known = np.isfinite(x)
    points = np.zeros(np.count_nonzero(known), POINT_DTYPE)
    for name, values in (("x", x), ("y", y), ("z", z)):
        points[name] = values[known] * 1e-3
    points["t"], points["column"] = line[known] / 70.0, column[known]
    points["sigma"], points["intensity"] = sigma_mm * 1e-3, 20
    return points


def moved(points, transform):
    """The cloud as an instrument at the pose ``transform`` measures it."""
    back = np.linalg.inv(transform)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1) @ back[:3, :3].T + back[:3, 3]
    seen = points.copy()
    for k, axis in enumerate("xyz"):
        seen[axis] = xyz[:, k]
    return seen
