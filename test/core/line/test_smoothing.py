"""Smoothing keeps slopes, steps and dark columns as they are."""

import numpy as np
import pytest
from line_events import encoded
from reconstructing import reconstruct

from eschorty_ros.core.evt3 import sort_readout
from eschorty_ros.core.reconstruction import Settings

# Too few columns for their scatter to set sigma.
COLUMN = np.arange(1280.0)
FEW = 16


def smoothed(row, half_width=2):
    """Row and sigma by column after smoothing; ``row`` is in quarters, NaN where it is dark."""
    lit = np.flatnonzero(np.isfinite(row))
    x = np.repeat(lit, 4)
    y = np.floor(row[x] + np.tile([0.0, 0.25, 0.5, 0.75], lit.size)).astype(int)
    events = sort_readout(np.full(x.size, 2000), x, y, np.ones(x.size, np.uint8))
    found, _ = reconstruct(encoded(events), settings=Settings(
        smoothing_half_width=half_width, isolation_events=0,
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
    mean = np.convolve(row, np.full(3, 1 / 3), "valid")
    np.testing.assert_allclose(smoothed(row, half_width=1)[0][1:-1], mean, rtol=0, atol=1e-12)


def test_a_plane_is_smoothed_over_all_columns_asked_for():
    rng = np.random.default_rng(5)
    row = 300 + 0.25 * rng.integers(-1, 2, 1280)
    mean = np.convolve(row, np.full(17, 1 / 17), "valid")
    out = smoothed(row, half_width=8)[0][8:-8]
    assert np.mean(np.abs(out - mean) < 1e-9) > 0.6, "seed 5"
    assert out.std() < 1.25 * mean.std(), "seed 5"


@pytest.mark.parametrize(("period", "kept"), [(8, 0.75), (12, 0.8), (24, 0.85), (96, 0.93)])
def test_detail_stays_where_the_columns_show_it(period, kept):
    """A wave of half a row is as exact as with the best of the fixed half widths."""
    rng = np.random.default_rng(7)
    wave = np.sin(2 * np.pi * np.arange(1280) / period)
    row = 300 + np.rint(4 * (0.5 * wave + rng.normal(0.0, 0.2, 1280))) / 4
    out = smoothed(row, half_width=8)[0] - 300.0
    assert 4.0 * np.mean(out * wave) > kept, "seed 7"
    fixed = [np.convolve(row - 300.0, np.full(n, 1 / n), "same") for n in (3, 5, 9, 17)]
    error, *errors = (np.std((rows - 0.5 * wave)[8:-8]) for rows in (out, *fixed))
    assert error < 1.25 * min(errors), "seed 7"


def test_a_plane_beside_a_relief_is_smoothed_as_a_plane():
    rng = np.random.default_rng(9)
    true = np.where(np.arange(1280) < 640, 0.5 * np.sin(np.arange(1280)), 0.0)
    row = 300 + np.rint(4 * (true + rng.normal(0.0, 0.2, 1280))) / 4
    error = smoothed(row, half_width=8)[0] - 300.0 - true
    assert error[704:-8].std() < 0.5 * error[8:576].std(), "seed 9"


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


@pytest.mark.parametrize("half_width", [1, 2])
def test_the_columns_own_variance_averages_out_and_the_shared_one_stays(half_width):
    row = np.full(FEW, 300.0)
    alone2, of_11 = (smoothed(row, half_width=n)[1][8] ** 2 for n in (0, 5))
    own2 = (alone2 - of_11) / (1.0 - 1.0 / 11.0)
    out, sigma = smoothed(row, half_width)
    np.testing.assert_array_equal(out, row)
    expected = np.sqrt(alone2 - own2 + own2 / (2 * half_width + 1))
    assert sigma[8] == pytest.approx(expected, rel=1e-12)
    # Of whole pixels, less what is known of where the row is in its pixel.
    assert alone2 - own2 == pytest.approx((1.0 - np.exp(-16.0 * np.pi**2 / 12.0)) / 12.0)


@pytest.mark.parametrize("scatter_px", [0.3, 0.6])
def test_sigma_is_the_scatter_of_the_columns(scatter_px):
    rng = np.random.default_rng(8)
    quarters = np.rint(rng.normal(0.0, 4 * scatter_px, 1280))
    row = 300 + 0.25 * quarters
    _, sigma = smoothed(row, half_width=0)
    assert np.sqrt(np.mean(sigma[100:-100] ** 2)) == pytest.approx(row.std(), rel=0.1)


@pytest.mark.parametrize(("together", "least"), [(3, 0.9), (6, 0.8), (12, 0.8)])
def test_sigma_has_what_near_columns_share(together, least):
    rng = np.random.default_rng(8)
    row = 300 + 0.25 * np.repeat(np.rint(rng.normal(0.0, 1.2, 1280 // together)), together)
    out, sigma = smoothed(row)
    inner = slice(100, -100)
    scatter_px = np.sqrt(np.mean((out[inner] - 300.0) ** 2))
    sigma_px = np.sqrt(np.mean(sigma[inner] ** 2))
    assert least < sigma_px / scatter_px < 1.1, "seed 8"


@pytest.mark.parametrize(
    ("curve_px", "times"),
    [
        (2e-4 * (COLUMN - 640.0) ** 2, 1.1),
        (6.0 * np.sin(COLUMN / 20.0), 2.0),
        (6.0 * np.sin(COLUMN / 8.0), 1.2),
        (2.0 * np.sin(COLUMN / 4.0), 1.2),
        (50.0 * (COLUMN // 5 % 3 == 0), 1.5),
    ],
    ids=["parabola", "wave", "ripple", "corrugation", "strips"],
)
def test_the_shape_of_a_surface_is_no_scatter(curve_px, times):
    noise_px = np.random.default_rng(8).normal(0.0, 0.2, 1280)
    flat, curved = (
        smoothed(300.0 + np.rint(4.0 * (true_px + noise_px)) / 4.0)[1]
        for true_px in (0.0, curve_px)
    )
    assert np.mean(curved[100:-100]) < times * np.mean(flat[100:-100]), "seed 8"


@pytest.mark.parametrize("step_px", [3.0, 6.0, 12.0])
def test_a_step_is_no_scatter_of_the_columns_beside(step_px):
    noise_px = np.random.default_rng(8).normal(0.0, 0.2, 1280)
    flat, stepped = (
        smoothed(300.0 + np.rint(4.0 * (true_px + noise_px)) / 4.0)[1]
        for true_px in (0.0, step_px * (COLUMN // 160 % 2))
    )
    to_step = np.abs((COLUMN + 80.5) % 160.0 - 80.0)
    beside = (to_step > 4.0) & (to_step < 40.0) & (COLUMN > 120.0) & (COLUMN < 1160.0)
    assert np.mean(stepped[beside]) < 1.2 * np.mean(flat[beside]), "seed 8"


def test_rows_that_do_not_scatter_have_the_sigma_of_whole_pixels():
    """A column's own variance, reduced by smoothing, is never taken as less than a 64th."""
    _, sigma = smoothed(np.full(400, 300.0))
    np.testing.assert_allclose(sigma[60:-60] ** 2, 1 / 12, rtol=1e-3)


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
