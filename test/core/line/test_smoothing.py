"""Smoothing keeps slopes, steps and dark columns as they are."""

from __future__ import annotations

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.line import smooth


def test_linear_slope_is_unbiased_everywhere():
    row = 300 + 0.3 * np.arange(50)
    out, _ = smooth(row, np.full(50, 0.4))
    np.testing.assert_allclose(out, row, rtol=0, atol=1e-12)


def test_step_is_not_blurred():
    row = np.where(np.arange(40) < 20, 300.0, 305.0)
    out, _ = smooth(row, np.full(40, 0.4), half_width=5)
    np.testing.assert_array_equal(out, row)


def test_dark_columns_stay_dark_and_stop_the_average():
    row = np.full(20, 300.0)
    row[10] = np.nan
    out, sigma = smooth(row, np.full(20, 0.4))
    np.testing.assert_array_equal(np.isnan(out), np.isnan(row))
    assert sigma[9] == pytest.approx(0.4)
    assert sigma[5] == pytest.approx(0.4 / np.sqrt(5))


def test_sigma_matches_the_scatter():
    rng = np.random.default_rng(5)
    row = 300 + rng.normal(0, 0.3, 20_000)
    out, sigma = smooth(row, np.full(row.size, 0.3), half_width=2)
    assert np.std(out - 300) == pytest.approx(np.sqrt(np.mean(sigma**2)), rel=0.05)


def test_common_part_of_the_error_does_not_average_out():
    rng = np.random.default_rng(6)
    common = np.repeat(rng.normal(0, 0.2, 4000), 5)
    row = 300 + common + rng.normal(0, 0.3, common.size)
    out, sigma = smooth(row, np.full(row.size, np.hypot(0.2, 0.3)), common_px=0.2)
    centres = slice(2, None, 5)
    expected = np.sqrt(np.mean(sigma[centres] ** 2))
    assert np.std(out[centres] - 300) == pytest.approx(expected, rel=0.05)


def test_zero_width_copies():
    row = np.array([1.0, 2.0, 3.0])
    out, sigma = smooth(row, np.ones(3), half_width=0)
    np.testing.assert_array_equal(out, row)
    np.testing.assert_array_equal(sigma, np.ones(3))


@pytest.mark.parametrize("options", [{"half_width": -1}, {"gate_px": float("nan")}])
def test_bad_arguments_are_refused(options):
    with pytest.raises(ArgumentError):
        smooth(np.zeros(3), np.zeros(3), **options)


def test_mismatched_shapes_are_refused():
    with pytest.raises(ArgumentError):
        smooth(np.zeros(3), np.zeros(4))
