"""Targets and choices at random: a report with finite numbers, or one line."""

import math

import numpy as np
import pytest
from calibration_posts import NOMINAL, see

from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration import WIDTH_BIAS, Targets, calibrate

SEED = 15


@pytest.mark.parametrize("first", [0, 50, 100])
def test_any_choice_gives_a_report_or_one_line(first):
    names = ("k_mm", "k_prime_px", "b_mm", "b_prime_px", "b_prime_1_px", "b_prime_2_px", WIDTH_BIAS)
    reports, lines = 0, []
    for seed in range(first, first + 50):
        rng = np.random.default_rng([SEED, seed])
        count = int(rng.integers(1, 14))
        targets = posts_at_random(rng, count)
        free = tuple(rng.permutation(names)[: rng.integers(1, 7)].tolist())
        options = {"free": free} if rng.random() < 0.7 else {}
        if options and rng.random() < 0.5:
            sigma = [math.inf, 1e-3, 1.0, 1e3]
            options["prior_sigma"] = {name: float(rng.choice(sigma)) for name in free}
        try:
            report = calibrate(targets, NOMINAL, **options)
        except (ArgumentError, FitError) as error:
            lines.append(str(error))
            continue
        reports += 1
        assert np.isfinite(report.fit.covariance).all()
        assert np.linalg.eigvalsh(report.fit.covariance).min() > 0.0
        assert np.isfinite(report.range_sigma_mm(300.0, 0.3))
    print(f"seed {SEED}: {reports} reports of 50")
    assert reports > 16
    assert not any("\n" in line for line in lines)


def posts_at_random(rng, count):
    """Posts anywhere, some with sizes and columns, some of them wrong, sigmas good or bad."""
    ranges = rng.uniform(850.0, 2050.0, count)
    size = np.where(rng.random(count) < 0.3, np.nan, rng.choice([10.0, 25.4, 50.8], count))
    seen = see(rng, ranges, size_mm=size, bloom_px=rng.uniform(0.0, 4.0))
    row = seen.row + np.where(rng.random(count) < 0.1, rng.uniform(-30.0, 30.0), 0.0)
    return Targets(
        np.clip(row, 0.0, 719.0), ranges, 10.0 ** rng.uniform(-3.0, 1.0),
        rng.choice([0.0, 1.0, 30.0]), rng.choice([np.nan, 1.0]) * rng.uniform(0, 1279, count),
        width_px=seen.width_px, size_mm=size,
    )  # fmt: skip
