"""Design numbers of the paper's builds, and the way back from wanted ranges to tilts."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import BUILDS, Design, design, design_for_ranges, load_calibration

LENS = {"focal_length_mm": 24.0, "f_number": 2.0, "theta_deg": 85.87}
RANGES_MM = [800.0, 1000.0, 1320.0, 1700.0, 2100.0, 2414.0]

# Tilt from k', baseline mm, depth of field in rows, row on the optical axis.
GOLDEN = {
    "nominal": (7.7735, 177.54, 14.65, 724.1),
    "config_1": (8.7643, 157.40, 12.97, 725.2),
    "config_2": (7.5846, 181.97, 15.02, 715.6),
    "config_3": (7.6157, 181.23, 14.96, 783.0),
}


def built(build: str) -> Design:
    """The design whose k' is exactly the printed one."""
    calibration = load_calibration(build)
    tilt = math.degrees(math.asin(24.0 / (4.86e-3 * -calibration.k_prime_px)))
    return design(**LENS, theta_prime_deg=-tilt, b_prime_px=calibration.b_prime_px)


@pytest.mark.parametrize("build", BUILDS)
def test_golden_values_of_each_build(build: str) -> None:
    tilt_deg, baseline_mm, rows, axis_row = GOLDEN[build]
    d, calibration = built(build), load_calibration(build)
    assert d.model.k_prime_px == pytest.approx(calibration.k_prime_px, rel=1e-14)
    assert d.range_limits_mm == pytest.approx(calibration.model().range_limits_mm, rel=1e-14)
    assert abs(d.theta_prime_deg) == pytest.approx(tilt_deg, abs=6e-5)
    assert abs(d.theta_prime_deg) == pytest.approx(abs(calibration.theta_prime_deg), abs=6e-3)
    assert d.baseline_mm == pytest.approx(baseline_mm, abs=6e-3)
    assert d.depth_of_field_rows == pytest.approx(rows, abs=6e-3)
    assert d.model.row(d.axis_range_mm) == pytest.approx(axis_row, abs=0.06)


def test_nominal_table() -> None:
    d = built("nominal")
    table = d.at(RANGES_MM)
    golden = {
        "magnification": ([0.0301, 0.0241, 0.0182, 0.0142, 0.0115, 0.0100], 6e-5),
        "range_per_row_mm": ([0.73, 1.14, 1.98, 3.29, 5.02, 6.63], 6e-3),
        "depth_of_field_mm": ([10.7, 16.7, 29.1, 48.2, 73.5, 97.2], 0.06),
        "lateral_pitch_mm": ([0.162, 0.202, 0.267, 0.343, 0.424, 0.488], 6e-4),
        "swath_mm": ([207, 259, 341, 439, 543, 624], 0.6),
    }
    for name, (values, tolerance) in golden.items():
        np.testing.assert_allclose(getattr(table, name), values, rtol=0, atol=tolerance)
    assert table.in_view.tolist() == [False, True, True, True, True, False]
    assert d.axis_range_mm == pytest.approx(2441.0, abs=0.5)
    assert d.field_deg == pytest.approx(14.73, abs=6e-3)
    assert 1e6 * d.model.slope_per_column == pytest.approx(202.0, abs=0.1)


def test_config_3_sampling_and_view() -> None:
    table = built("config_3").at(RANGES_MM)
    per_row_mm = [0.71, 1.12, 1.94, 3.22, 4.92]
    np.testing.assert_allclose(table.range_per_row_mm[:5], per_row_mm, rtol=0, atol=6e-3)
    assert table.in_view.tolist() == [True, True, True, True, True, False]


def test_printed_depth_sampling_is_millimetres_per_metre() -> None:
    for build, values in {"nominal": [0.91, 2.85], "config_3": [0.89, 2.79]}.items():
        table = built(build).at([800.0, 2500.0])
        per_metre = table.range_per_row_mm / table.range_mm * 1e3
        np.testing.assert_allclose(per_metre, values, rtol=0, atol=6e-3)


@pytest.mark.parametrize("build", BUILDS)
def test_depth_of_field_over_range_step_is_constant(build: str) -> None:
    d = built(build)
    table = d.at(np.linspace(500.0, 4000.0, 50))
    rows = table.depth_of_field_mm / table.range_per_row_mm
    np.testing.assert_allclose(rows, d.depth_of_field_rows, rtol=1e-13)


@pytest.mark.parametrize("build", BUILDS)
def test_thin_lens_images_the_sheet_onto_the_tilted_sensor(build: str) -> None:
    """Lens at the origin, z along the axis, the Scheimpflug line at y = L.

    Thin-lens images of the sheet's points lie on the sensor plane, in the rows of Eq. 2 and the
    columns of the lateral scale.
    """
    d = built(build)
    theta, tilt = math.radians(d.theta_deg), math.radians(abs(d.theta_prime_deg))
    focal, pitch = d.focal_length_mm, d.model.pixel_um * 1e-3
    depth = np.linspace(800.0, 2500.0, 100)
    z = focal + depth * math.sin(theta)
    y = d.baseline_mm - z / math.tan(theta)
    image_z = -focal * z / (z - focal)
    image_y = image_z * y / z
    from_line = np.hypot(d.baseline_mm - image_y, image_z)
    np.testing.assert_allclose(-image_z / from_line, math.sin(tilt), rtol=1e-12)
    infinity = focal / math.sin(tilt)
    row = (infinity - from_line) / pitch - d.model.b_prime_px
    np.testing.assert_allclose(row, d.model.row(depth - d.model.b_mm), rtol=0, atol=1e-9)
    lateral = 640.0 * pitch * z / -image_z
    np.testing.assert_allclose(lateral, d.model.lateral_mm(1279.5, depth), rtol=1e-12)


@settings(derandomize=True, max_examples=100, deadline=None)
@given(
    st.floats(300.0, 2000.0), st.floats(1.05, 719.0), st.floats(8.0, 75.0), st.floats(45.0, 90.0)
)
def test_ranges_to_design_and_back(near: float, ratio: float, focal: float, theta: float) -> None:
    wanted = {"near_mm": near, "far_mm": near * ratio, "b_mm": 2.0}
    lens = {"focal_length_mm": focal, "f_number": 2.0, "theta_deg": theta}
    depths = near + 2.0, near * ratio + 2.0
    k_mm = focal / math.sin(math.radians(theta))
    sine = focal * k_mm * (1 / depths[0] - 1 / depths[1]) / (719 * 4.86e-3)
    if sine >= 1.0:
        with pytest.raises(ArgumentError, match="sin"):
            design_for_ranges(**wanted, **lens)
        return
    d = design_for_ranges(**wanted, **lens)
    assert d.range_limits_mm == pytest.approx((near, near * ratio), rel=1e-11)
    again = design(**lens, baseline_mm=d.baseline_mm, b_prime_px=d.model.b_prime_px, b_mm=2.0)
    assert again.theta_prime_deg == pytest.approx(d.theta_prime_deg, rel=1e-11)
    assert again.model.k_prime_px == pytest.approx(d.model.k_prime_px, rel=1e-11)


@pytest.mark.parametrize("build", BUILDS)
def test_wanted_ranges_of_a_build_give_its_tilt(build: str) -> None:
    model = load_calibration(build).model()
    near, far = model.range_limits_mm
    d = design_for_ranges(near_mm=near, far_mm=far, **LENS)
    assert d.model.k_prime_px == pytest.approx(model.k_prime_px, rel=1e-12)
    assert d.model.b_prime_px == pytest.approx(model.b_prime_px, rel=1e-12)
    assert abs(d.theta_prime_deg) == pytest.approx(GOLDEN[build][0], abs=6e-5)


def test_near_range_in_place_of_the_row_offset() -> None:
    d = design(**LENS, theta_prime_deg=7.62, near_mm=784.6)
    assert d.range_limits_mm[0] == pytest.approx(784.6, rel=1e-14)
    assert d.theta_prime_deg == 7.62


def test_sheet_along_the_axis_never_crosses_it() -> None:
    d = design(**LENS | {"theta_deg": 90.0}, theta_prime_deg=-7.6, b_prime_px=-1100)
    assert (d.axis_range_mm, d.model.k_mm) == (math.inf, 24.0)
    assert d.model.row(d.axis_range_mm) == 1100.0


TILTED = {**LENS, "theta_prime_deg": -7.62, "b_prime_px": -1100.0}
RANGED = {**LENS, "near_mm": 800.0, "far_mm": 2000.0}


@pytest.mark.parametrize(
    ("make", "values", "message"),
    [
        (design, {**TILTED, "baseline_mm": 180.0}, "exactly one"),
        (design, {**TILTED, "near_mm": 800.0}, "exactly one"),
        (design, {**TILTED, "b_prime_px": None}, "exactly one"),
        (design, {**TILTED, "b_prime_px": None, "near_mm": -3.0}, "near_mm is -3.0.* = 0 mm"),
        (
            design,
            {**TILTED, "b_prime_px": None, "near_mm": 1e9},
            "near_mm is 1000000000.0.*less than 896116",
        ),
        (design, {**TILTED, "theta_prime_deg": None, "baseline_mm": 1.0}, "more than f cot"),
        (design_for_ranges, {**RANGED, "far_mm": 700.0}, "far_mm is 700"),
        (design_for_ranges, {**RANGED, "rows": 1}, "rows is 1"),
        (design_for_ranges, {**RANGED, "near_mm": 20.0}, "sin"),
        (design_for_ranges, {**RANGED, "far_mm": 577e3}, "far_mm is 577000.0.* less than 576000"),
    ],
)
def test_impossible_builds_are_refused(make: object, values: dict, message: str) -> None:
    with pytest.raises(ArgumentError, match=message) as caught:
        make(**values)
    assert "\n" not in str(caught.value)
