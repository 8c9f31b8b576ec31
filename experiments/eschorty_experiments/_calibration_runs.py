"""Calibrations of posts whose truth is known: by every method, with outliers, with intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eschorty_experiments._measured_posts import measured_posts
from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.calibration import (
    K_PRIOR_SHARE,
    PARAMETERS,
    PRIOR_SIGMA,
    WIDTH_BIAS,
    CalibrationFit,
    Targets,
    calibrate,
    fit,
)
from eschorty_ros.core.optics import Calibration, RangeModel

CHECK_MM = np.array([800.0, 1000.0, 1320.0, 1700.0, 2100.0])
FINE_MM = np.linspace(790.0, 2110.0, 34)
NINE_MM = np.linspace(820.0, 2050.0, 9)
SIX_MM = np.linspace(1150.0, 1300.0, 6)
FOUR_MM = np.linspace(820.0, 2050.0, 4)
OUTLIER_POSTS, OUTLIERS = 25, 3
OUTLIER_PX = (8.0, 30.0)
BLOOM_PX = 4.0
ONE_INCH, TWO_INCH = 25.4, 50.8
COVERAGE_RUNS = 500
_WITHIN = 1.959964


@dataclass(frozen=True, slots=True)
class Case:
    """The scene in front of the instrument."""

    name: str
    range_mm: Array
    posts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Method:
    """The parameters that are fitted, with or without the priors of `calibrate`."""

    name: str
    free: tuple[str, ...]
    prior: bool


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Errors of one method in one case: RMS over the repeats."""

    range_rms_mm: Array
    scale_rms: float
    condition: float


TWO_SIZES_MM = np.where(np.arange(9) % 2, ONE_INCH, TWO_INCH)
CASES = (
    Case("9 posts, one size", NINE_MM, {"size_mm": ONE_INCH}),
    Case("9 posts, one size, bloomed", NINE_MM, {"size_mm": ONE_INCH, "bloom_px": BLOOM_PX}),
    Case("9 posts, two sizes, bloomed", NINE_MM, {"size_mm": TWO_SIZES_MM, "bloom_px": BLOOM_PX}),
    Case("9 posts, spacings of 100 mm", NINE_MM, {"spacing_mm": 100.0}),
    Case("4 posts, one size", FOUR_MM, {"size_mm": ONE_INCH}),
    Case("6 posts in 1150-1300 mm", SIX_MM, {"size_mm": ONE_INCH}),
)
PAPER = Method("paper", ("k_prime_px", "b_prime_px"), False)
FREE_B = Method("b free, no prior", ("k_prime_px", "b_mm", "b_prime_px"), False)
SIZES = Method("joint, bloom left out", PARAMETERS, True)
JOINT = Method("joint, bloom fitted", (*PARAMETERS, WIDTH_BIAS), True)
METHODS = (PAPER, FREE_B, SIZES, JOINT)


def _priors(design: RangeModel, free: tuple[str, ...]) -> dict[str, float]:
    known = {"k_mm": K_PRIOR_SHARE * design.k_mm, **PRIOR_SIGMA}
    return {name: known[name] for name in free}


def _fit(targets: Targets, design: RangeModel, method: Method) -> CalibrationFit:
    priors = _priors(design, method.free) if method.prior else None
    return fit(targets, design, method.free, prior_sigma=priors)


def compare(
    case: Case, design: RangeModel, truth: RangeModel, rng: np.random.Generator, repeats: int
) -> dict[str, Score]:
    """Repeat the calibration of one case by every method that applies; return scores by method."""
    # Without known sizes there is no width bias to fit.
    sized = "size_mm" in case.posts
    methods = [method for method in METHODS if sized or WIDTH_BIAS not in method.free]
    errors: dict[str, list[Array]] = {method.name: [] for method in methods}
    scales: dict[str, list[float]] = {method.name: [] for method in methods}
    conditions: dict[str, list[float]] = {method.name: [] for method in methods}
    true_row = truth.row(FINE_MM)
    for _ in range(repeats):
        targets = measured_posts(truth, case.range_mm, rng, **case.posts)
        for method in methods:
            found = _fit(targets, design, method)
            # A far row behind the fitted pole has no range and counts as an infinite error.
            error = np.nan_to_num(found.model.range_mm(true_row) - FINE_MM, nan=np.inf)
            errors[method.name].append(error)
            ratio = found.model.lateral_mm(1200.0, 1320.0) / truth.lateral_mm(1200.0, 1320.0)
            scales[method.name].append(float(ratio) - 1.0)
            conditions[method.name].append(found.condition_number)
    return {
        method.name: Score(
            np.sqrt(np.mean(np.square(errors[method.name]), axis=0)),
            float(np.sqrt(np.mean(np.square(scales[method.name])))),
            float(np.median(conditions[method.name])),
        )
        for method in methods
    }


def outliers(
    nominal: Calibration, truth: RangeModel, rng: np.random.Generator, repeats: int
) -> tuple[Array, Array]:
    """Return errors at the farthest check range: joint fit with rejection, plain least squares."""
    ranges = np.linspace(NINE_MM[0], NINE_MM[-1], OUTLIER_POSTS)
    far_mm, far_row = CHECK_MM[-1], truth.row(CHECK_MM[-1])
    robust, plain = [], []
    for _ in range(repeats):
        good = measured_posts(truth, ranges, rng)
        wrong = rng.choice(OUTLIER_POSTS, OUTLIERS, replace=False)
        row = good.row.copy()
        # Inwards, so that they stay on the sensor.
        away = np.where(row[wrong] > 0.5 * truth.rows, -1.0, 1.0)
        row[wrong] += rng.uniform(*OUTLIER_PX, OUTLIERS) * away
        targets = Targets(row, ranges, good.sigma_row_px, good.sigma_range_mm)
        robust.append(float(calibrate(targets, nominal).fit.model.range_mm(far_row)) - far_mm)
        plain.append(float(fit(targets, nominal.model()).model.range_mm(far_row)) - far_mm)
    return np.array(robust), np.array(plain)


def coverage(design: RangeModel, rng: np.random.Generator) -> dict[str, float]:
    """Return the share of truths inside their stated 95 % interval, by quantity."""
    priors = _priors(design, JOINT.free)
    inside = []
    for _ in range(COVERAGE_RUNS):
        drawn = {name: rng.normal(getattr(design, name), priors[name]) for name in PARAMETERS}
        truth = replace(design, **drawn)
        bloom = rng.normal(0.0, priors[WIDTH_BIAS])
        targets = measured_posts(truth, NINE_MM, rng, size_mm=TWO_SIZES_MM, bloom_px=bloom)
        targets = targets.select((targets.row > 0.0) & (targets.row < design.rows - 1.0))
        found = fit(targets, design, JOINT.free, prior_sigma=priors)
        sigma = np.sqrt(np.diag(found.covariance))[: len(PARAMETERS)]
        error = [getattr(found.model, name) - drawn[name] for name in PARAMETERS]
        away = found.model.range_mm(truth.row(CHECK_MM)) - CHECK_MM
        inside.append(np.abs([*(error / sigma), *(away / found.range_sigma_mm(CHECK_MM))]))
    share = np.mean(np.array(inside) < _WITHIN, axis=0)
    names = [*PARAMETERS, *(f"range at {at:.0f} mm" for at in CHECK_MM)]
    return dict(zip(names, share.tolist(), strict=True))
