"""What targets determine, and what they do not."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import CalibrationError, FitError
from eschorty_ros.core.calibration import PARAMETERS, CalibrationFit, Targets, fit
from eschorty_ros.core.optics import BUILDS, RangeModel, load_calibration

SEED = 13
NOMINAL = load_calibration("nominal").model()
TRUTH = load_calibration("config_3").model()
CLUSTERED_MM = np.linspace(1150.0, 1300.0, 6)
SPREAD_MM = np.linspace(820.0, 2050.0, 9)
DATUM_FREE = ("k_prime_px", "b_mm", "b_prime_px")


def relative(found: CalibrationFit, truth: RangeModel) -> float:
    """Largest relative error of the parameters that were fitted."""
    return max(
        abs(getattr(found.model, n) - getattr(truth, n)) / max(abs(getattr(truth, n)), 1.0)
        for n in found.free
    )


def rows_of(truth: RangeModel, ranges_mm: np.ndarray) -> np.ndarray:
    """Eq. 2 with 50 digits, rounded once."""
    with mpmath.workdps(50):
        product = mpmath.mpf(truth.k_mm) * mpmath.mpf(truth.k_prime_px)
        depths = [mpmath.mpf(float(r)) + truth.b_mm for r in ranges_mm]
        return np.array([float(product / depth - truth.b_prime_px) for depth in depths])


@pytest.mark.parametrize("build", BUILDS)
@pytest.mark.hard_case(12)
def test_noiseless_targets_of_table_1_return_the_build(build, measured):
    truth = load_calibration(build).model()
    ranges = np.linspace(1.01 * truth.range_limits_mm[0], 0.99 * truth.range_limits_mm[1], 9)
    found = fit(Targets(rows_of(truth, ranges), ranges), NOMINAL)
    measured("9 targets of Table 1, k' and b', relative", relative(found, truth), 1e-9)
    assert (found.verdicts, found.dof) == ((), 7)
    free = fit(Targets(rows_of(truth, ranges), ranges), NOMINAL, DATUM_FREE)
    measured("the same with b free", relative(free, truth), 1e-9)


@pytest.mark.hard_case(12)
def test_clustered_posts_keep_all_digits(measured):
    """Posts at 1150..1300 mm: raw normal equations would square a condition number of 2.9e4."""
    found = fit(Targets(rows_of(TRUTH, CLUSTERED_MM), CLUSTERED_MM), NOMINAL)
    measured("posts 1150-1300 mm, k' and b', relative", relative(found, TRUTH), 1e-12)
    assert found.condition_number == pytest.approx(47.75, abs=0.01)


@pytest.mark.hard_case(12)
def test_weighted_line_equals_50_digits(measured):
    rng = np.random.default_rng(SEED)
    ranges = np.sort(rng.uniform(1150.0, 1300.0, 12))
    rows = TRUTH.row(ranges) + rng.normal(0.0, 0.5, 12)
    sigma = rng.uniform(0.1, 3.0, 12)
    found = fit(Targets(rows, ranges, sigma), NOMINAL)
    with mpmath.workdps(50):
        x = [1 / mpmath.mpf(float(r)) for r in ranges]
        y = [mpmath.mpf(float(r)) for r in rows]
        w = [1 / mpmath.mpf(float(s)) ** 2 for s in sigma]
        xm, ym = mpmath.fdot(w, x) / sum(w), mpmath.fdot(w, y) / sum(w)
        spread = sum(a * (b - xm) ** 2 for a, b in zip(w, x, strict=True))
        product = sum(a * (b - xm) * (c - ym) for a, b, c in zip(w, x, y, strict=True)) / spread
        k_prime, b_prime = product / mpmath.mpf(NOMINAL.k_mm), product * xm - ym
        errors = (
            abs(found.model.k_prime_px / k_prime - 1),
            abs(found.model.b_prime_px / b_prime - 1),
            abs(found.covariance[0, 0] * mpmath.mpf(NOMINAL.k_mm) ** 2 * spread - 1),
        )
        measured("noisy weighted posts against 50 digits, relative", max(errors), 1e-12)


@settings(derandomize=True, max_examples=150, deadline=None)
@given(
    st.floats(-60_000.0, -15_000.0),
    st.floats(-1500.0, -900.0),
    st.floats(-20.0, 20.0),
    st.lists(st.integers(0, 719), min_size=3, max_size=30, unique=True),
)
@pytest.mark.hard_case(12)
def test_any_build_comes_back(k_prime_px, b_prime_px, b_mm, rows):
    truth = RangeModel(NOMINAL.k_mm, k_prime_px, b_mm, b_prime_px)
    design = RangeModel(NOMINAL.k_mm, NOMINAL.k_prime_px, b_mm, NOMINAL.b_prime_px)
    found = fit(Targets(np.array(rows, float), truth.range_mm(rows)), design)
    # What rounding the ranges to 53 bits leaves, over the span of the rows.
    bound = 2.0**-52 * (1.0 + 8.0 * 1500.0 / np.ptp(rows))
    assert relative(found, truth) <= 4.0 * bound


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.permutations(range(9)))
@pytest.mark.hard_case(12)
def test_order_of_targets_does_not_change_a_bit(order):
    rng = np.random.default_rng(SEED)
    rows, index = TRUTH.row(SPREAD_MM) + rng.normal(0.0, 0.3, 9), np.array(order)
    a = fit(Targets(rows, SPREAD_MM), NOMINAL)
    b = fit(Targets(rows[index], SPREAD_MM[index]), NOMINAL)
    assert a.model == b.model


@pytest.mark.parametrize("ranges", [(800.0, 2100.0), (1200.0, 1300.0), (1200.0, 1200.5)])
@pytest.mark.hard_case(13)
def test_two_posts_are_solved_exactly(ranges, measured):
    rows = TRUTH.row(ranges)
    found = fit(Targets(rows, ranges, 0.3), NOMINAL)
    first, second = (Fraction(r) for r in ranges)
    row_1, row_2 = (Fraction(float(r)) for r in rows)
    product = float((row_1 - row_2) / (1 / first - 1 / second))
    error = abs(found.model.product_mm_px / product - 1.0)
    # Reciprocals rounded to 53 bits limit posts half a millimetre apart.
    limit = max(1e-12, 2.0**-52 * ranges[0] / (ranges[1] - ranges[0]))
    measured(f"posts at {ranges[0]:g} and {ranges[1]:g} mm, K, relative", error, limit)
    assert found.dof == 0
    assert np.isnan(found.reduced_chi_square)
    assert any("no degrees of freedom" in line for line in found.verdicts)
    slope = 0.3 * np.sqrt(2.0) / float(1 / first - 1 / second) / NOMINAL.k_mm
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(slope, rel=1e-9)


@pytest.mark.parametrize(
    ("rows", "ranges"),
    [
        ([300.0], [1200.0]),
        ([300.0, 301.0], [1200.0, 1200.0]),
        ([300.0, 301.0, 299.0], [1200.0, 1200.0, 1200.0]),
        ([300.0, 301.0], [1200.0, 1200.0 * (1 + 2.0**-50)]),
        ([300.0, 300.0, 300.0], [1000.0, 1200.0, 1400.0]),
    ],
)
@pytest.mark.parametrize("free", [("k_prime_px", "b_prime_px"), DATUM_FREE])
@pytest.mark.hard_case(14)
def test_singular_targets_are_refused_with_the_condition_number(rows, ranges, free):
    with pytest.raises(FitError, match=r"condition number inf.*; give targets") as refused:
        fit(Targets(rows, ranges), NOMINAL, free)
    assert "\n" not in str(refused.value)
    assert isinstance(refused.value, CalibrationError)


@pytest.mark.hard_case(14)
def test_targets_that_approach_the_camera_as_rows_grow_are_no_build():
    with pytest.raises(FitError, match="k_prime_px is"):
        fit(Targets([500.0, 300.0], [1000.0, 1500.0]), NOMINAL)


@pytest.mark.parametrize("ranges", [CLUSTERED_MM, SPREAD_MM])
@pytest.mark.hard_case(15)
def test_four_free_parameters_are_refused(ranges):
    targets = Targets(TRUTH.row(ranges), ranges)
    with pytest.raises(FitError, match=r"condition number inf; .*k_mm k_prime_px"):
        fit(targets, NOMINAL, PARAMETERS)
    priors = {"k_mm": 0.24, "b_mm": 3.0, "b_prime_px": 60.0, "k_prime_px": 3000.0}
    found = fit(targets, NOMINAL, PARAMETERS, prior_sigma=priors)
    assert found.covariance.shape == (4, 4)
    assert np.abs(found.model.range_mm(TRUTH.row(ranges)) - ranges).max() < 0.05


@pytest.mark.hard_case(16)
def test_free_datum_on_clustered_posts_is_a_warning(measured):
    rng = np.random.default_rng(SEED)
    far_mm, errors = 2400.0, []
    for _ in range(200):
        rows = TRUTH.row(CLUSTERED_MM) + rng.normal(0.0, 0.3, 6)
        found = fit(Targets(rows, CLUSTERED_MM), TRUTH, DATUM_FREE)
        assert any(line.startswith("ill-conditioned") for line in found.verdicts)
        errors.append(float(found.model.range_mm(TRUTH.row(far_mm))) - far_mm)
    exact = fit(Targets(rows_of(TRUTH, CLUSTERED_MM), CLUSTERED_MM), NOMINAL, DATUM_FREE)
    assert exact.condition_number == pytest.approx(2832.0, rel=1e-3)
    measured("noiseless clustered posts, b free, relative", relative(exact, TRUTH), 1e-8)
    half, sigma_mm = float(np.nanmedian(np.abs(errors))), float(exact.range_sigma_mm(far_mm))
    print(f"seed {SEED}: median error at 2.4 m {half:.0f} mm, stated {sigma_mm:.0f} mm")
    assert 50.0 < half < 1000.0
    assert 0.3 < half / (0.6745 * sigma_mm) < 3.0


@pytest.mark.hard_case(16)
def test_spread_posts_or_a_prior_lift_the_warning():
    assert fit(Targets(TRUTH.row(SPREAD_MM), SPREAD_MM), NOMINAL, DATUM_FREE).verdicts == ()
    clustered = Targets(TRUTH.row(CLUSTERED_MM), CLUSTERED_MM)
    held = fit(clustered, TRUTH, DATUM_FREE, prior_sigma={"b_mm": 3.0})
    assert held.verdicts == ()
    assert float(held.range_sigma_mm(2400.0)) < 30.0
