"""Measurements of posts at known ranges, with noise and without events."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.calibration import SIGMA_ROW_PX, Targets
from eschorty_ros.core.optics import RangeModel

SIGMA_RANGE_MM = 1.0
SIGMA_WIDTH_PX = 0.42


def measured_posts(
    truth: RangeModel,
    range_mm: NDArray[np.float64],
    rng: np.random.Generator,
    *,
    size_mm: ArrayLike = np.nan,
    spacing_mm: ArrayLike = np.nan,
    bloom_px: float = 0.0,
    noise: float = 1.0,
) -> Targets:
    """Return measurements of posts, with Gaussian errors of rows, ranges, widths and spacings.

    - ``truth``: The true instrument.
    - ``range_mm``: Measured ranges, shape (n,); the true ones differ by ``SIGMA_RANGE_MM``.
    - ``size_mm``, ``spacing_mm``: Sizes of the posts, distances of two marks on them, one for all
      or shape (n,); NaN for none.
    - ``bloom_px``: Columns by which light widens every post.
    - ``noise``: Share of the errors that is drawn; the stated sigmas stay.
    """
    count = range_mm.size
    true_mm = range_mm + noise * rng.normal(0.0, SIGMA_RANGE_MM, count)
    row = truth.row(true_mm) + noise * rng.normal(0.0, SIGMA_ROW_PX, count)
    columns_per_mm = truth.k_mm / (truth.pixel_um * 1e-3 * (true_mm + truth.b_mm))
    width, spacing = noise * rng.normal(0.0, SIGMA_WIDTH_PX, (2, count))
    return Targets(
        row,
        range_mm,
        SIGMA_ROW_PX,
        SIGMA_RANGE_MM,
        width_px=np.asarray(size_mm) * columns_per_mm + bloom_px + width,
        size_mm=size_mm,
        sigma_width_px=SIGMA_WIDTH_PX,
        spacing_px=np.asarray(spacing_mm) * columns_per_mm + spacing,
        spacing_mm=spacing_mm,
        sigma_spacing_px=SIGMA_WIDTH_PX,
    )
