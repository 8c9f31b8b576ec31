"""Range equation against the paper's Table 1, 50-digit arithmetic and the pole."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper_builds import TABLE_1, exact_k_mm, exact_range_mm

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import BUILDS, RangeModel, load_calibration

ROWS = np.arange(720)

# Recomputed with unrounded k: K mm px, R(0), R(719), R(720) mm, m at row 0.
RECOMPUTED = {
    "nominal": (-878528, 810.450, 2406.927, 2413.539, 0.02969),
    "config_1": (-779855, 718.072, 2124.713, 2130.517, 0.03351),
    "config_2": (-900269, 837.226, 2526.718, 2533.829, 0.02874),
    "config_3": (-896613, 784.617, 2115.951, 2120.956, 0.03067),
}

models = st.builds(
    RangeModel,
    k_mm=st.floats(1.0, 200.0),
    k_prime_px=st.floats(-1e6, -1e3),
    b_mm=st.floats(-50.0, 50.0),
    b_prime_px=st.floats(-5000.0, -1.0),
)


def model(build: str) -> RangeModel:
    return load_calibration(build).model()


@pytest.mark.parametrize("build", BUILDS)
def test_table_1_ranges_within_0_03_mm(build: str) -> None:
    _, _, near_mm, far_mm, far_row = TABLE_1[build]
    assert float(model(build).range_mm(0)) == pytest.approx(near_mm, abs=0.03)
    assert float(model(build).range_mm(far_row)) == pytest.approx(far_mm, abs=0.03)


@pytest.mark.parametrize("build", BUILDS)
def test_recomputed_values_of_each_build(build: str) -> None:
    product, near_mm, far_mm, after_mm, magnification = RECOMPUTED[build]
    m = model(build)
    assert m.product_mm_px == pytest.approx(product, abs=0.6)
    assert m.range_mm([0, 719, 720]) == pytest.approx([near_mm, far_mm, after_mm], rel=0, abs=6e-4)
    assert m.range_limits_mm == (float(m.range_mm(0)), float(m.range_mm(719)))
    assert float(m.magnification(0)) == pytest.approx(magnification, abs=6e-6)


@pytest.mark.parametrize("build", BUILDS)
def test_derived_quantities_against_50_digits(build: str) -> None:
    m = model(build)
    with mpmath.workdps(50):
        exact = exact_range_mm(build, ROWS)
        k = exact_k_mm()
        product = abs(k * mpmath.mpf(TABLE_1[build][0]))
        step = np.array([float(r * r / product) for r in exact])
        scale = np.array([float(k / r) for r in exact])
        column = mpmath.mpf("1279") - mpmath.mpf("639.5")
        lateral = np.array([float(column * mpmath.mpf("0.00486") * r / k) for r in exact])
    ranges = m.range_mm(ROWS)
    np.testing.assert_allclose(m.range_per_row_mm(ranges), step, rtol=2e-15)
    np.testing.assert_allclose(m.magnification(ROWS), scale, rtol=1e-15)
    np.testing.assert_allclose(m.lateral_mm(1279, ranges), lateral, rtol=2e-15)
    np.testing.assert_allclose(m.range_sigma_mm(ROWS, 0.25), 0.25 * step, rtol=2e-15)


def test_pole_on_the_sensor_gives_an_infinite_far_limit() -> None:
    m = RangeModel(24.0, -37000.0, 0.0, -400.0)
    assert m.range_limits_mm == (pytest.approx(2220.0), np.inf)
    assert np.isnan(m.range_mm(ROWS[400:])).all()
    assert (m.range_mm(ROWS[:400]) > 0.0).all()


def test_lateral_scale_of_the_paper() -> None:
    m = model("nominal")
    assert 1e3 * float(m.column_slope(640) - m.column_slope(639)) == pytest.approx(0.202, abs=5e-4)
    ranges = [810.45, 1320.0, 2413.5]
    swath = m.lateral_mm(1279, ranges) - m.lateral_mm(0, ranges)
    np.testing.assert_allclose(swath * 1280 / 1279, [209.5, 341.3, 624.0], atol=0.1)
    np.testing.assert_allclose(m.lateral_mm(639.5, [900.0, 2000.0]), 0.0)
    assert float(m.lateral_mm(700, 1000.0)) == -float(m.lateral_mm(579, 1000.0))


def test_pinhole_scale_would_be_wrong_by_the_stated_amount() -> None:
    """X grows with R + b from the front focal line, not with the distance to the lens."""
    m = model("nominal")
    column = 639.5 + 0.12 / float(m.column_slope(640.5))
    assert float(m.lateral_mm(column, 1320.0)) == pytest.approx(0.12 * 1320.0, rel=1e-12)
    z_mm = 24.0 + 1320.0 * np.sin(np.radians(85.87))
    pinhole = 0.12 * float(m.k_mm) * z_mm / 24.0
    assert pinhole - 0.12 * 1320.0 == pytest.approx(2.9, abs=0.05)


def test_arguments_broadcast_and_keep_their_shape() -> None:
    m = model("config_3")
    assert m.range_mm(3).shape == ()
    assert m.range_mm(ROWS.reshape(72, 10).astype(np.uint16)).shape == (72, 10)
    assert m.lateral_mm(np.arange(5)[:, None], np.full(3, 900.0)).shape == (5, 3)
    assert m.range_sigma_mm(np.arange(4.0), 0.2).shape == (4,)
    assert m.range_mm(np.float32(3)).dtype == np.float64


@settings(derandomize=True, max_examples=200, deadline=None)
@given(models, st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=50))
def test_depth_is_positive_and_grows_with_row_or_is_nan(m: RangeModel, rows: list[float]) -> None:
    row = np.sort(np.array(rows))
    depth = m.range_mm(row) + m.b_mm
    seen = row + m.b_prime_px <= -1.0
    assert np.isnan(depth[~seen]).all()
    assert (depth[seen] > 0.0).all()
    assert (np.diff(depth[seen]) >= 0.0).all()


@settings(derandomize=True, max_examples=200, deadline=None)
@given(models, st.floats(0.0, 719.0), st.floats(0.0, 2.0))
def test_sigma_is_the_slope_of_the_range(m: RangeModel, row: float, sigma_row: float) -> None:
    if row + m.b_prime_px > -2.0:
        assert row + m.b_prime_px <= -1.0 or np.isnan(m.range_sigma_mm(row, sigma_row))
        return
    slope = float(m.range_mm(row + 1e-4) - m.range_mm(row - 1e-4)) / 2e-4
    sigma_mm = float(m.range_sigma_mm(row, sigma_row))
    assert sigma_mm == pytest.approx(sigma_row * slope, rel=1e-4, abs=1e-6 * slope)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(models, st.floats(-500.0, 719.0))
def test_round_trip_of_any_build(m: RangeModel, row: float) -> None:
    image = row + m.b_prime_px
    if image > -1.0:
        return
    # R = depth - b loses digits where the depth is small against b.
    depth = m.product_mm_px / image
    bound = 8 * np.finfo(float).eps * (abs(m.b_prime_px) + abs(image) * (1 + abs(m.b_mm) / depth))
    assert float(m.row(m.range_mm(row))) == pytest.approx(row, abs=bound)


@pytest.mark.parametrize("build", BUILDS)
def test_rows_beside_the_sheet_agree_with_traced_chief_rays(build: str) -> None:
    calibration = load_calibration(build)
    m = calibration.model()
    theta = np.radians(calibration.theta_deg)
    focal = calibration.focal_length_mm
    tilt = np.arcsin(focal / (m.pixel_um * 1e-3 * -m.k_prime_px))
    baseline = focal * (1.0 / np.tan(theta) + 1.0 / np.tan(tilt))

    def row(range_mm: float, beside_mm: float) -> float:
        # Lens at the origin, z along the axis, y towards the Scheimpflug line at y = baseline.
        z = focal + (range_mm + m.b_mm) * np.sin(theta)
        y = baseline - z / np.tan(theta)
        z, y = z + beside_mm * np.cos(theta), y + beside_mm * np.sin(theta)
        # The ray y = slope z meets the sensor, which runs through the same line.
        behind = baseline / (1.0 / np.tan(tilt) - y / z)
        return -(behind - focal) / (m.pixel_um * 1e-3 * np.sin(tilt)) - m.b_prime_px

    for range_mm in (810.0, 1320.0, 2100.0):
        assert row(range_mm, 0.0) == pytest.approx(float(m.row(range_mm)), abs=1e-9)
        moved = (row(range_mm, 1e-3) - row(range_mm, -1e-3)) / 2e-3
        assert -moved == pytest.approx(float(m.rows_per_mm_off_sheet(range_mm)), rel=1e-6)


def test_one_millimetre_beside_the_sheet_costs_what_the_table_says() -> None:
    m = model("nominal")
    ranges = [810.0, 1320.0, 2410.0]
    rows = m.rows_per_mm_off_sheet(ranges)
    assert rows == pytest.approx([6.2, 3.8, 2.1], abs=0.05)
    assert rows * m.range_per_row_mm(ranges) == pytest.approx([4.6, 7.5, 13.6], abs=0.1)
    with pytest.raises(ArgumentError, match="k_prime_px is -3000"):
        RangeModel(24.0, -3000.0, 0.0, -400.0).rows_per_mm_off_sheet(1000.0)


def test_roll_and_smile_move_the_rows_of_the_outer_columns() -> None:
    straight = load_calibration("config_3").model()
    bent = replace(straight, b_prime_1_px=-6.0, b_prime_2_px=2.5)
    ranges, columns = np.linspace(800.0, 2000.0, 7)[:, None], np.array([0.0, 639.5, 1279.0])
    u = np.array([-639.5, 0.0, 639.5]) / 640.0
    moved = bent.row(ranges, columns) - straight.row(ranges)
    np.testing.assert_allclose(moved, np.broadcast_to(6.0 * u - 2.5 * u * u, (7, 3)), atol=1e-9)
    back = bent.range_mm(bent.row(ranges, columns), columns)
    np.testing.assert_allclose(back, np.broadcast_to(ranges, (7, 3)), rtol=1e-12)
    np.testing.assert_array_equal(bent.row(ranges), straight.row(ranges))
    np.testing.assert_array_equal(bent.range_mm([100.0], [639.5]), straight.range_mm([100.0]))
    assert bent.range_sigma_mm(700.0, 0.3, 1279.0) < bent.range_sigma_mm(700.0, 0.3, 0.0)
    with pytest.raises(ArgumentError, match="row and column have shapes"):
        bent.range_mm([1.0, 2.0], [1.0, 2.0, 3.0])
    with pytest.raises(ArgumentError, match="b_prime_2_px is nan"):
        replace(straight, b_prime_2_px=float("nan"))
    with pytest.raises(ArgumentError, match="the pole comes before row 0"):
        replace(straight, b_prime_1_px=1200.0)
