"""Posts at known ranges, measured by a build, and the calibration made from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.calibration import CalibrationFit, Targets, fit
from eschorty_ros.core.optics import Design

SIGMA_ROW_PX = 0.3
SIGMA_EDGE_PX = 0.3
POSTS = 11
POST_MM = 25.4
MARGIN_ROWS = 15.0
"""Posts keep this far from the sensor's edge."""


@dataclass(frozen=True, slots=True)
class Line:
    """Magnification as a straight line in row."""

    slope: float
    """Per px; ``1 / k'`` by Eq. 1."""
    zero_row: float
    """Row of magnification 0; ``-b'`` by Eq. 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Posts:
    """Posts of one build; arrays of shape (POSTS,)."""

    range_mm: Array
    row: Array
    """Known range; measured row."""
    magnification: Array
    """From the columns a post covers and its size."""
    fit: CalibrationFit
    """k' and b' from rows and ranges, k and b at their design values."""
    line: Line
    """Through the magnifications; independent of ``fit``."""


def measure_posts(build: Design, nominal: Design, rng: np.random.Generator) -> Posts:
    """Place posts evenly in range, measure their rows and widths with noise, calibrate.

    - ``build``: The instrument as built.
    - ``nominal``: The source of the fit's fixed k and b.
    """
    model = build.model
    near, far = model.range_mm([MARGIN_ROWS, model.rows - 1 - MARGIN_ROWS])
    ranges = np.linspace(near, far, POSTS)
    true_row = model.row(ranges)
    row = true_row + rng.normal(0.0, SIGMA_ROW_PX, POSTS)
    pixel_mm = model.pixel_um * 1e-3
    edges = rng.normal(0.0, SIGMA_EDGE_PX, (2, POSTS))
    columns = model.magnification(true_row) * POST_MM / pixel_mm + edges[1] - edges[0]
    magnification = columns * pixel_mm / POST_MM
    slope, start = np.polyfit(row, magnification, 1)
    found = fit(Targets(row, ranges, SIGMA_ROW_PX), nominal.model)
    return Posts(ranges, row, magnification, found, Line(float(slope), float(-start / slope)))


def pulls(posts: Posts, build: Design) -> Array:
    """Return the errors of the fitted k' and b' over their standard deviations, shape (2,)."""
    error = [
        posts.fit.model.k_prime_px - build.model.k_prime_px,
        posts.fit.model.b_prime_px - build.model.b_prime_px,
    ]
    return np.asarray(error / np.sqrt(np.diag(posts.fit.covariance)))
