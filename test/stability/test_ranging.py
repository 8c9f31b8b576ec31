"""Hard cases 1, 2, 3, 17, 18 and 19: the range equation near its limits."""

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_events import blank_profiles
from paper_builds import exact_range_mm

from eschorty_ros.core.optics import BUILDS, RangeModel, depth_of_field_mm, load_calibration
from eschorty_ros.core.reconstruction import place
from eschorty_ros.core.storage import POINT_DTYPE

ROWS = np.arange(720)
POLE_DISTANCES_PX = np.array([1e-12, 1e-9, 1e-6, 1e-3, 0.5, 0.999999])


def model(build: str) -> RangeModel:
    return load_calibration(build).model()


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.hard_case(1)
def test_range_evaluation(build, measured):
    """Every row against 50 digits from the decimal numbers of the file."""
    with mpmath.workdps(50):
        errors = [
            abs(mpmath.mpf(float(ours)) / exact - 1)
            for exact, ours in zip(
                exact_range_mm(build, ROWS), model(build).range_mm(ROWS), strict=True
            )
        ]
        measured("rows 0..719 to mm, relative", max(errors), 4e-16)


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.hard_case(2)
def test_pole_is_invalid_and_never_a_sign_flip(build):
    m = model(build)
    pole = -m.b_prime_px
    beyond = pole + np.concatenate([-POLE_DISTANCES_PX, POLE_DISTANCES_PX, [0.0, 1.0, 50.0, 1e9]])
    for result in (m.range_mm(beyond), m.range_sigma_mm(beyond, 1.0)):
        assert np.isnan(result).all()
    assert np.isnan(m.range_mm([np.nan, np.inf])).all()
    assert np.isnan(m.magnification(pole + 1.0))


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.hard_case(2)
def test_last_valid_row_keeps_all_digits(build, measured):
    m = model(build)
    row = -m.b_prime_px - np.array([1.0, 1.5, 10.0])
    with mpmath.workdps(50):
        exact = [
            mpmath.mpf(m.k_mm) * mpmath.mpf(m.k_prime_px) / (mpmath.mpf(float(r)) + m.b_prime_px)
            for r in row
        ]
        errors = [abs(a / b - 1) for a, b in zip(map(float, m.range_mm(row)), exact, strict=True)]
        measured("1 to 10 px before the pole, relative", max(errors), 4e-16)


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.hard_case(3)
def test_row_to_range_and_back(build, measured):
    rows = np.linspace(0.0, 719.0, 20_001)
    back = model(build).row(model(build).range_mm(rows))
    measured("row to range and back, px", np.abs(back - rows).max(), 1e-12)


@pytest.mark.hard_case(17)
def test_forward_map_at_and_behind_the_front_focal_line_is_nan():
    m = RangeModel(24.06, -37000.0, 5.0, -1140.0)
    bad = np.array([-5.0, -5.0000001, -1000.0, np.nan, -np.inf])
    for result in (m.row(bad), m.range_per_row_mm(bad), m.lateral_mm(0, bad)):
        assert np.isnan(result).all()
    assert np.isfinite(m.row(-4.999)).all()


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.floats(-1e6, 1e6), st.floats(-100.0, 100.0))
@pytest.mark.hard_case(17)
def test_forward_map_is_finite_or_flagged(range_mm, b_mm):
    m = RangeModel(24.06, -37000.0, b_mm, -1140.0)
    row = float(m.row(range_mm))
    assert np.isnan(row) == (range_mm + b_mm <= 1e-300)
    # A range this side of the front focal line is never taken for a row behind the pole.
    assert not row > -m.b_prime_px


@pytest.mark.hard_case(18)
def test_limits_at_the_pole_are_infinite_without_complaint():
    m = model("config_3")
    assert float(m.magnification(-m.b_prime_px)) == 0.0
    assert float(depth_of_field_mm(0.0, 2.0, 85.87, -7.62, 4.86)) == np.inf
    assert float(depth_of_field_mm(1e-200, 2.0, 85.87, -7.62, 4.86)) == np.inf
    assert float(m.range_per_row_mm(np.inf)) == np.inf
    assert float(m.range_per_row_mm(1e200)) == np.inf
    assert float(m.row(np.inf)) == -m.b_prime_px


@pytest.mark.parametrize(
    ("range_mm", "limit_um"), [(2400.0, 0.24), (100_000.0, 7.7)], ids=["2.4 m", "100 m"]
)
@pytest.mark.hard_case(19)
def test_points_are_rounded_to_float32_once(range_mm, limit_um, measured):
    """Half a spacing of float32, wherever in a millimetre the range falls; t stays float64."""
    ranges = range_mm - np.linspace(0.0, 1.0, 4001)
    n = ranges.size
    t_us = 1_760_000_000_000_000 + np.arange(n)
    profiles = blank_profiles(n, range_mm=ranges, t_us=t_us)
    points = place(profiles, model("config_3"), 0.0, (0.0, 1.0, 0.0), int(t_us[0]))
    error_um = np.abs(points["x"].astype(np.float64) - ranges * 1e-3).max() * 1e6
    measured(f"x at {range_mm / 1000:g} m, um", error_um, limit_um)
    assert POINT_DTYPE["x"] == np.dtype("<f4")
    np.testing.assert_allclose(points["t"], np.arange(n) * 1e-6, rtol=1e-15)
