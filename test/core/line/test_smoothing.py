"""Smoothing keeps slopes, steps and dark columns as they are."""

import numpy as np
import pytest
from line_events import encoded
from reconstructing import reconstruct

from eschorty_ros.core.evt3 import sort_readout
from eschorty_ros.core.reconstruction import Settings

COMMON_PX = 0.2
# Too few columns for their scatter to set sigma.
FEW = 16


def smoothed(row, half_width=2):
    """Row and sigma by column after smoothing; ``row`` is in quarters, NaN where it is dark."""
    lit = np.flatnonzero(np.isfinite(row))
    x = np.repeat(lit, 4)
    y = np.floor(row[x] + np.tile([0.0, 0.25, 0.5, 0.75], lit.size)).astype(int)
    events = sort_readout(np.full(x.size, 2000), x, y, np.ones(x.size, np.uint8))
    found, _ = reconstruct(encoded(events), settings=Settings(
        smoothing_half_width=half_width, sigma_common_px=COMMON_PX, isolation_events=0,
    ))  # fmt: skip
    out, sigma = np.full((2, row.size), np.nan)
    out[found.column], sigma[found.column] = found.row, found.sigma_row
    return out, sigma


def test_linear_slope_is_unbiased_everywhere():
    row = 300 + 0.25 * np.arange(50)
    np.testing.assert_allclose(smoothed(row)[0], row, rtol=0, atol=1e-12)


def test_each_row_is_the_mean_of_the_columns_around_it():
    rng = np.random.default_rng(5)
    row = 300 + 0.25 * rng.integers(-4, 5, 1280)
    mean = np.convolve(row, np.full(5, 0.2), "valid")
    np.testing.assert_allclose(smoothed(row)[0][2:-2], mean, rtol=0, atol=1e-12)


def test_step_is_not_blurred():
    row = np.where(np.arange(40) < 20, 300.0, 305.0)
    np.testing.assert_array_equal(smoothed(row, half_width=5)[0], row)


def test_dark_columns_stay_dark_and_end_the_average():
    row = np.full(FEW, 300.0)
    row[8] = np.nan
    out, sigma = smoothed(row)
    alone = smoothed(row, half_width=0)[1]
    np.testing.assert_array_equal(np.isnan(out), np.isnan(row))
    assert sigma[7] == pytest.approx(alone[7], rel=1e-12)
    assert sigma[4] < alone[4]


@pytest.mark.parametrize("half_width", [0, 1, 2, 5])
def test_the_columns_own_variance_averages_out_and_the_shared_one_stays(half_width):
    row = np.full(FEW, 300.0)
    own2 = smoothed(row, half_width=0)[1] ** 2 - COMMON_PX**2
    out, sigma = smoothed(row, half_width)
    np.testing.assert_array_equal(out, row)
    expected = np.sqrt(COMMON_PX**2 + own2[8] / (2 * half_width + 1))
    assert sigma[8] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("scatter_px", [0.3, 0.6])
def test_sigma_is_the_scatter_of_the_columns(scatter_px):
    rng = np.random.default_rng(8)
    quarters = np.rint(rng.normal(0.0, 4 * scatter_px, 1280))
    row = 300 + 0.25 * quarters
    _, sigma = smoothed(row, half_width=0)
    inner = np.sqrt(sigma[100:-100] ** 2 - COMMON_PX**2)
    assert np.sqrt(np.mean(inner**2)) == pytest.approx(row.std(), rel=0.1)


def test_sigma_has_what_near_columns_share():
    rng = np.random.default_rng(8)
    row = 300 + 0.25 * np.repeat(np.rint(rng.normal(0.0, 1.2, 426)), 3)
    out, sigma = smoothed(row)
    inner = slice(100, -100)
    scatter_px = np.sqrt(np.mean((out[inner] - 300.0) ** 2))
    sigma_px = np.sqrt(np.mean(sigma[inner] ** 2 - COMMON_PX**2))
    assert sigma_px == pytest.approx(scatter_px, rel=0.1), "seed 8"


def test_rows_that_do_not_scatter_have_the_sigma_of_whole_pixels():
    _, sigma = smoothed(np.full(200, 300.0))
    np.testing.assert_allclose(sigma[20:-20] ** 2, COMMON_PX**2 + 1 / 12, rtol=1e-12)


@pytest.mark.parametrize("slope", [0.004, 0.02, 0.05])
def test_sigma_of_evenly_lit_rows_is_that_of_their_two_ends(slope):
    """Both ends of 20 rows go to the next pixel at once: neighbours have the same error."""
    true = 300.0 + slope * np.arange(1280)
    lit = np.abs(np.arange(400)[:, None] - true) < 10.0
    y, x = np.nonzero(lit)
    events = sort_readout(np.full(x.size, 2000), x, y, np.ones(x.size, np.uint8))
    found, _ = reconstruct(encoded(events), settings=Settings(isolation_events=0))
    error_px = np.sqrt(np.mean((found.row - true[found.column]) ** 2))
    assert np.sqrt(np.mean(found.sigma_row**2)) == pytest.approx(error_px, rel=0.15)
