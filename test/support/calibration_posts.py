"""The Monte Carlo set-up that the calibration's numbers are stated for."""

from dataclasses import replace
from typing import Any

import numpy as np
from eschorty_experiments._calibration_runs import CHECK_MM, NINE_MM
from eschorty_experiments._calibration_runs import TWO_SIZES_MM as TWO_SIZES_MM
from eschorty_experiments._measured_posts import measured_posts

from eschorty_ros.core.calibration import Targets
from eschorty_ros.core.optics import RangeModel, load_calibration

NOMINAL = load_calibration("config_3")
DESIGN = NOMINAL.model()
TRUTH = replace(DESIGN, k_mm=24.20, k_prime_px=-37100.0, b_mm=1.5, b_prime_px=-1140.0)
COLUMN = 1200.0


def see(
    rng: np.random.Generator,
    ranges_mm: np.ndarray = NINE_MM,
    *,
    truth: RangeModel = TRUTH,
    **posts: Any,
) -> Targets:
    """Posts of ``truth`` with noise in rows, ranges, widths and spacings."""
    return measured_posts(truth, ranges_mm, rng, **posts)


def range_error_mm(model: RangeModel, truth: RangeModel = TRUTH) -> np.ndarray:
    return model.range_mm(truth.row(CHECK_MM)) - CHECK_MM


def scale_error(model: RangeModel) -> float:
    """Relative error of a lateral length at mid-range."""
    return float(model.lateral_mm(COLUMN, 1320.0) / TRUTH.lateral_mm(COLUMN, 1320.0)) - 1.0
