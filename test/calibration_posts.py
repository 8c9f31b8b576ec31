"""Synthetic posts: the Monte Carlo set-up that the calibration's numbers are stated for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from eschorty_ros.core.calibration import load_calibration
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.targets import Targets

NOMINAL = load_calibration("config_3")
DESIGN = NOMINAL.model()
TRUTH = replace(DESIGN, k_mm=24.20, k_prime_px=-37100.0, b_mm=1.5, b_prime_px=-1140.0)
NINE_MM = np.linspace(820.0, 2050.0, 9)
TWO_SIZES_MM = np.where(np.arange(9) % 2, 25.4, 50.8)
CHECK_MM = np.array([800.0, 1000.0, 1320.0, 1700.0, 2100.0])
SIGMA_ROW_PX, SIGMA_RANGE_MM, SIGMA_WIDTH_PX = 0.3, 1.0, 0.42
COLUMN = 1200.0


def see(
    rng: np.random.Generator,
    ranges_mm: np.ndarray = NINE_MM,
    *,
    truth: RangeModel = TRUTH,
    size_mm: Any = np.nan,
    spacing_mm: Any = np.nan,
    bloom_px: float = 0.0,
    noise: float = 1.0,
) -> Targets:
    """Posts of ``truth`` with noise in rows, ranges, widths and spacings."""
    count = ranges_mm.size
    true_mm = ranges_mm + noise * rng.normal(0.0, SIGMA_RANGE_MM, count)
    row = truth.row(true_mm) + noise * rng.normal(0.0, SIGMA_ROW_PX, count)
    columns_per_mm = truth.k_mm / (truth.pixel_um * 1e-3 * (true_mm + truth.b_mm))
    edges = noise * rng.normal(0.0, SIGMA_WIDTH_PX, (2, count))
    return Targets(
        row,
        ranges_mm,
        SIGMA_ROW_PX,
        SIGMA_RANGE_MM,
        width_px=size_mm * columns_per_mm + bloom_px + edges[0],
        size_mm=size_mm,
        sigma_width_px=SIGMA_WIDTH_PX,
        spacing_px=spacing_mm * columns_per_mm + edges[1],
        spacing_mm=spacing_mm,
        sigma_spacing_px=SIGMA_WIDTH_PX,
    )


def range_error_mm(model: RangeModel, truth: RangeModel = TRUTH) -> np.ndarray:
    """Error of ``model`` at `CHECK_MM`."""
    return model.range_mm(truth.row(CHECK_MM)) - CHECK_MM


def scale_error(model: RangeModel, truth: RangeModel = TRUTH) -> float:
    """Relative error of a lateral length at mid-range."""
    return float(model.lateral_mm(COLUMN, 1320.0) / truth.lateral_mm(COLUMN, 1320.0)) - 1.0
