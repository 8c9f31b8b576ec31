"""What a calibration must reach on synthetic posts, whose truth is known."""

import math

import numpy as np
import pytest
from calibration_posts import (
    CHECK_MM,
    DESIGN,
    NOMINAL,
    TWO_SIZES_MM,
    range_error_mm,
    scale_error,
    see,
)

from eschorty_ros.core.calibration import (
    K_PRIOR_SHARE,
    PARAMETERS,
    PRIOR_SIGMA,
    WIDTH_BIAS,
    Targets,
    calibrate,
    fit,
)
from eschorty_ros.core.optics import BUILDS, RangeModel, load_calibration

SEED = 14
PRIORS = {"k_mm": K_PRIOR_SHARE * DESIGN.k_mm, **PRIOR_SIGMA}
JOINT = ("k_mm", "k_prime_px", "b_mm", "b_prime_px", WIDTH_BIAS)


def priors(names):
    return {name: PRIORS[name] for name in names}


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def noiseless(truth: RangeModel) -> Targets:
    near, far = truth.range_limits_mm
    ranges, rng = np.linspace(1.01 * near, 0.99 * far, 9), np.random.default_rng(SEED)
    return see(rng, ranges, truth=truth, size_mm=TWO_SIZES_MM, noise=0.0, bloom_px=4)


@pytest.mark.parametrize("build", BUILDS)
def test_noiseless_posts_of_table_1_return_the_build(build):
    truth, start = load_calibration(build).model(), load_calibration("nominal")
    targets = noiseless(truth)
    joint = calibrate(targets, start, prior_sigma=dict.fromkeys(JOINT, math.inf))
    for name in PARAMETERS:
        found, true = getattr(joint.fit.model, name), getattr(truth, name)
        assert found == pytest.approx(true, rel=1e-9, abs=1e-8), name
    assert joint.fit.width_bias_px == pytest.approx(4.0, abs=1e-8)
    assert (joint.rejected, joint.used.all()) == ((), True)


def test_outliers_of_8_to_30_px_are_found_where_least_squares_follows_them():
    rng = np.random.default_rng(SEED)
    ranges = np.linspace(820.0, 2050.0, 25)
    robust, plain, found = [], [], 0
    for _ in range(60):
        good = see(rng, ranges)
        wrong = rng.choice(25, 3, replace=False)
        row = good.row.copy()
        row[wrong] += rng.uniform(8.0, 30.0, 3) * np.where(row[wrong] > 360.0, -1.0, 1.0)
        targets = Targets(row, ranges, good.sigma_row_px, good.sigma_range_mm)
        report = calibrate(targets, NOMINAL)
        found += len(set(wrong.tolist()) & {entry.index for entry in report.rejected})
        robust.append(range_error_mm(report.fit.model)[-1])
        plain.append(range_error_mm(fit(targets, DESIGN).model)[-1])
    print(f"seed {SEED}: at 2100 mm robust {rms(robust):.2f} mm, plain {rms(plain):.2f} mm")
    print(f"{found} of {3 * 60} outliers found; worst robust error {np.abs(robust).max():.2f} mm")
    assert rms(robust) <= 2.5
    assert rms(plain) >= 2.0 * 2.5


@pytest.mark.parametrize(
    ("shape", "bloom_px", "free", "limit"),
    [
        pytest.param({"size_mm": 25.4}, 0.0, JOINT[:4], 0.0025, id="one size, no blooming"),
        pytest.param({"size_mm": TWO_SIZES_MM}, 4.0, JOINT, 0.0025, id="two sizes, blooming"),
        pytest.param({"spacing_mm": 100.0}, 4.0, JOINT[:4], 0.0025, id="spacings"),
    ],
)
def test_nine_posts_give_range_and_lateral_scale(shape, bloom_px, free, limit):
    rng = np.random.default_rng(SEED)
    ranges, scales, paper = [], [], []
    for _ in range(150):
        targets = see(rng, bloom_px=bloom_px, **shape)
        model = fit(targets, DESIGN, free, prior_sigma=priors(free)).model
        ranges.append(range_error_mm(model))
        scales.append(scale_error(model))
        paper.append(range_error_mm(fit(targets, DESIGN).model))
    print(f"seed {SEED}: lateral scale {1e2 * rms(scales):.3f} %, range {rms(ranges).round(2)} mm")
    print(f"paper's method: {rms(paper).round(2)} mm at {CHECK_MM} mm")
    assert rms(scales) <= limit
    assert (rms(ranges) <= 1.05 * rms(paper)).all()
    assert rms(ranges).max() <= 1.35


def test_blooming_left_out_of_the_model_ruins_the_lateral_scale():
    rng = np.random.default_rng(SEED)
    scales = []
    for _ in range(60):
        targets = see(rng, size_mm=25.4, bloom_px=4.0)
        found = [fit(targets, DESIGN, free, prior_sigma=priors(free)).model
                 for free in (JOINT[:4], JOINT)]  # fmt: skip
        scales.append([scale_error(model) for model in found])
    without, modelled = rms(scales)
    print(f"seed {SEED}: {1e2 * without:.2f} % without the width bias, {1e2 * modelled:.2f} % with")
    assert without > 0.03
    assert modelled < 0.006


def test_stated_intervals_cover_the_truth():
    """Truths drawn from the priors: then 95 % intervals hold it 95 times in 100."""
    rng = np.random.default_rng(SEED)
    inside = []
    for _ in range(500):
        drawn = {name: rng.normal(getattr(DESIGN, name), PRIORS[name]) for name in PARAMETERS}
        truth = RangeModel(**drawn)
        targets = see(rng, truth=truth, size_mm=TWO_SIZES_MM, bloom_px=rng.normal(0.0, 3.0))
        targets = targets.select((targets.row > 0.0) & (targets.row < 719.0))
        found = fit(targets, DESIGN, JOINT, prior_sigma=priors(JOINT))
        sigma = np.sqrt(np.diag(found.covariance))[:4]
        error = [getattr(found.model, name) - drawn[name] for name in PARAMETERS]
        of_ranges = range_error_mm(found.model, truth) / found.range_sigma_mm(CHECK_MM)
        inside.append(np.abs([*(error / sigma), *of_ranges]) < 1.959964)
    coverage = np.mean(inside, axis=0)
    print(f"seed {SEED}: coverage of k, k', b, b' {coverage[:4]}, of ranges {coverage[4:]}")
    assert ((coverage >= 0.92) & (coverage <= 0.98)).all()


def test_intervals_of_the_papers_method_cover_too_and_so_does_rejection():
    rng = np.random.default_rng(SEED)
    truth = RangeModel(DESIGN.k_mm, -37100.0, 0.0, -1140.0)
    inside, robust, reduced = [], [], []

    def covered(found):
        pulls = range_error_mm(found.model, truth) / found.range_sigma_mm(CHECK_MM)
        return np.abs(pulls) < 1.959964

    for index in range(500):
        targets = see(rng, truth=truth)
        found = fit(targets, DESIGN)
        inside.append(covered(found))
        reduced.append(found.reduced_chi_square)
        if index < 150:
            robust.append(covered(calibrate(targets, NOMINAL, "paper", robust=True).fit))
    coverage = np.mean(inside, axis=0)
    print(f"seed {SEED}: coverage {coverage}, with rejection {np.mean(robust, axis=0)}")
    assert ((coverage >= 0.92) & (coverage <= 0.98)).all()
    assert np.mean(robust) >= 0.92
    assert np.mean(reduced) == pytest.approx(1.0, abs=0.07)
