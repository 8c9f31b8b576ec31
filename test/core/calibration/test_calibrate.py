"""Calibration reports: verdicts, diagnostics, refusals."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from calibration_posts import DESIGN, NINE_MM, NOMINAL, TRUTH, TWO_SIZES_MM, see

from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration import PRIOR_SIGMA, WIDTH_BIAS, Targets, calibrate, fit
from eschorty_ros.core.optics import load_calibration, save_calibration

SEED = 15
ALL_ROWS_MM = np.concatenate([np.linspace(790.0, 1500.0, 8), np.linspace(1720.0, 2090.0, 6)])


def posts(**changes):
    return see(np.random.default_rng(SEED), **changes)


def changed(targets: Targets, at: int, **values: float) -> Targets:
    """The same targets with some numbers of one of them replaced."""
    kept = {name: getattr(targets, name).copy() for name in ("row", "range_mm")}
    for name, value in values.items():
        kept[name][at] = value
    return Targets(kept["row"], kept["range_mm"], targets.sigma_row_px, targets.sigma_range_mm)


def test_the_file_holds_the_fit_and_reads_back(tmp_path):
    report = calibrate(posts(size_mm=TWO_SIZES_MM), NOMINAL, date="2025-11-02")
    save_calibration(report.calibration, tmp_path / "calibration.yaml")
    read = load_calibration(tmp_path / "calibration.yaml")
    assert read == report.calibration
    assert read.model() == report.fit.model
    assert (read.name, read.range_mm) == ("config_3", (820.0, 2050.0))
    assert read.id.startswith("config_3-2025-11-02-")
    assert read.parameters_fitted == ("k_mm", "k_prime_px", "b_mm", "b_prime_px")
    assert np.array(read.covariance) == pytest.approx(report.fit.covariance[:4, :4], rel=1e-12)
    again = calibrate(posts(size_mm=TWO_SIZES_MM), NOMINAL, date="2025-11-02")
    assert again.calibration == read
    paper = calibrate(posts(), NOMINAL, "paper").calibration
    assert (paper.k_mm, paper.b_mm, paper.date) == (None, 0.0, None)
    assert paper.id != read.id


def test_well_spread_targets_are_identifiable_and_nothing_else():
    targets = see(np.random.default_rng(SEED), ALL_ROWS_MM)
    assert calibrate(targets, NOMINAL, "paper").verdicts == ("identifiable",)


def test_verdicts_name_what_the_targets_leave_open():
    near = posts(ranges_mm=np.linspace(1150.0, 1300.0, 6))
    lines = calibrate(near, NOMINAL).verdicts
    assert "identifiable" not in lines
    assert any(line.startswith("prior dominates b_mm") for line in lines)
    outside = next(line for line in lines if line.startswith("extrapolates outside"))
    assert "1150 to 1300 mm" in outside
    assert any(line.startswith("0 of 6 targets are in the far third") for line in lines)
    two = calibrate(posts(ranges_mm=np.array([800.0, 2100.0])), NOMINAL, "paper")
    assert any(line.startswith("no degrees of freedom") for line in two.verdicts)
    assert "identifiable" not in two.verdicts


def test_a_sensor_that_sees_infinity_says_so():
    """The pole is on the sensor: the last rows have no range."""
    nominal = replace(NOMINAL, theta_prime_deg=-60.0, k_prime_px=-5702.2, b_prime_px=-274.4)
    targets = see(np.random.default_rng(SEED), np.linspace(520.0, 3000.0, 9), truth=nominal.model())
    lines = calibrate(targets, nominal).verdicts
    assert any("the sensor covers 500 mm to infinity" in line for line in lines)
    assert not any("nan" in line for line in lines)


def test_residuals_larger_than_stated_are_reported():
    targets = posts(ranges_mm=ALL_ROWS_MM)
    understated = Targets(targets.row, targets.range_mm, 0.02, 0.0)
    lines = calibrate(understated, NOMINAL, "paper").verdicts
    assert any(line.startswith("residuals exceed the stated sigmas") for line in lines)
    far = Targets(DESIGN.row(NINE_MM) - 10.0, NINE_MM + 30.0, 0.3, 0.0)
    assert any("b_mm is" in line for line in calibrate(far, NOMINAL).verdicts)


def test_an_outlier_is_named_with_its_reason():
    targets = posts()
    report = calibrate(changed(targets, 6, row=targets.row[6] - 12.0), NOMINAL)
    (rejected,) = report.rejected
    assert (rejected.index, rejected.label) == (6, "7")
    assert re.match("row .*sigma from the curve of the others", rejected.reason)
    assert report.used.tolist() == [i != 6 for i in range(9)]
    assert report.residual_px[6] == pytest.approx(-12.0, abs=1.5)
    assert report.leave_one_out_px[6] == report.residual_px[6]
    assert any(line == "1 of 9 targets rejected: 7" for line in report.verdicts)


def test_a_wrong_width_is_an_outlier_too():
    targets = posts(size_mm=TWO_SIZES_MM)
    width = targets.width_px.copy()
    width[2] *= 2.0
    sized = {"width_px": width, "size_mm": TWO_SIZES_MM, "sigma_width_px": 0.42}
    wrong = Targets(targets.row, targets.range_mm, 0.3, 1.0, **sized)
    (rejected,) = calibrate(wrong, NOMINAL).rejected
    assert (rejected.index, rejected.reason.split()[0]) == (2, "width")


def test_leave_one_out_is_the_residual_of_a_fit_without_the_target():
    targets = posts(size_mm=TWO_SIZES_MM)
    for method, tolerance in (("paper", 1e-6), ("joint", 0.02)):
        report = calibrate(targets, NOMINAL, method)
        for index in range(9):
            others = targets.select(np.arange(9) != index)
            alone = fit(others, DESIGN, report.fit.free, prior_sigma=report.fit.prior_sigma)
            expected = targets.row[index] - float(alone.model.row(targets.range_mm[index]))
            found = report.leave_one_out_px[index]
            # Weights depend on the fitted curve by a part in a thousand.
            assert found == pytest.approx(expected, rel=0.01, abs=tolerance), (method, index)
    two = calibrate(posts(ranges_mm=np.array([800.0, 2100.0])), NOMINAL, "paper")
    assert np.isnan(two.leave_one_out_px).all()


def test_profile_of_k_is_the_parabola_of_its_sigma():
    report = calibrate(posts(size_mm=TWO_SIZES_MM), NOMINAL, prior_sigma={"k_mm": math.inf})
    sigma = math.sqrt(report.fit.covariance[0, 0])
    low, high = report.profile.interval_mm
    assert high - low == pytest.approx(2 * 1.96 * sigma, rel=0.03)
    assert low < report.fit.model.k_mm < high
    assert report.profile.delta_chi_square.min() == 0.0
    assert report.profile.delta_chi_square[0] == pytest.approx(16.0, rel=0.05)
    assert calibrate(posts(), NOMINAL).profile is None


def test_sigma_grows_with_range_and_includes_the_centroids():
    report = calibrate(posts(), NOMINAL)
    rows = np.array([50.0, 400.0, 719.0])
    own, both = report.range_sigma_mm(rows), report.range_sigma_mm(rows, 0.3)
    model = report.fit.model
    np.testing.assert_allclose(both**2 - own**2, model.range_sigma_mm(rows, 0.3) ** 2, rtol=1e-9)
    assert both[0] < both[1] < both[2]


@pytest.mark.parametrize("free", [("k_prime_px", "b_prime_px"), None])
def test_an_error_that_all_ranges_share_is_in_the_sigma(free):
    """One target on a stage, measured 4 mm too far: 4 sigma of nothing else, 4 mm / 3 of this."""
    ranges = np.linspace(850.0, 2000.0, 200)
    row = TRUTH.row(ranges) + np.random.default_rng(SEED).normal(0.0, 0.1, 200)
    targets = Targets(row, ranges + 4.0, 0.1, 0.01, sigma_shared_mm=3.0)
    report = calibrate(targets, NOMINAL, free=free)
    pulls = report.residual_mm / report.range_sigma_mm(row)
    true_mm = np.array([900.0, 1320.0, 1900.0])
    error = report.fit.model.range_mm(TRUTH.row(true_mm)) - true_mm
    ratio = error / report.range_sigma_mm(TRUTH.row(true_mm))
    print(f"seed {SEED}: errors {error} mm, {ratio} sigma; residuals {np.abs(pulls).max():.2f}")
    assert ratio == pytest.approx(4.0 / 3.0, abs=0.25)
    assert np.nanmax(np.abs(report.leave_one_out_px - report.residual_px)) < 0.02


def test_roll_and_smile_come_back_from_a_target_at_many_columns():
    truth = replace(TRUTH, b_prime_1_px=-6.0, b_prime_2_px=2.5)
    rng = np.random.default_rng(SEED)
    ranges = np.tile(ALL_ROWS_MM, 3) + 20.0
    column = np.repeat([80.0, 640.0, 1200.0], ALL_ROWS_MM.size)
    row = truth.row(ranges, column) + rng.normal(0.0, 0.3, ranges.size)
    targets = Targets(row, ranges, column=column)
    free = ("k_prime_px", "b_mm", "b_prime_px", "b_prime_1_px", "b_prime_2_px")
    report = calibrate(targets, NOMINAL, free=free)
    assert report.fit.model.b_prime_1_px == pytest.approx(-6.0, abs=0.3)
    assert report.fit.model.b_prime_2_px == pytest.approx(2.5, abs=0.5)
    assert np.abs(report.residual_mm).max() < 7.0
    assert np.sqrt(np.mean(report.residual_px**2)) == pytest.approx(0.3, rel=0.25)
    refused(ArgumentError, Targets(row, ranges), free=free, match="column of target 1 is unknown")
    bent = replace(NOMINAL, b_prime_1_px=-6.0, b_prime_2_px=2.5)
    with pytest.raises(ArgumentError, match="unknown and b_prime_1_px of the nominal build is -6;"):
        calibrate(Targets(row, ranges), bent)
    assert np.abs(calibrate(targets, bent).residual_mm).max() < 7.0


def refused(error, targets, *args, match, **options):
    with pytest.raises(error, match=match) as caught:
        calibrate(targets, NOMINAL, *args, **options)
    assert "\n" not in str(caught.value)


def test_targets_that_determine_no_build_are_refused_with_the_cause():
    targets = posts()
    same_range = Targets([300.0, 300.5], [1200.0, 1200.0])
    for method in ("paper", "joint"):
        refused(FitError, same_range, method, match="range_mm holds 1 different ranges")
        refused(FitError, Targets([], []), method, match="there are 0 targets")
        refused(FitError, targets.select([0]), method, match="holds 1 different ranges")
        aside = Targets(targets.row, targets.range_mm, column=12000.0)
        refused(ArgumentError, aside, method, match="column of target 1 is 12000; the sensor has c")
        off = changed(targets, 3, row=720.0)
        refused(ArgumentError, off, method, match="row of target 4 is 720; the sensor has rows 0")
        twin = Targets.concatenate([targets, targets.select([2])])
        refused(ArgumentError, twin, method, match="targets 3 and 3 are the same.*remove one")
        torn = changed(targets, 3, range_mm=targets.range_mm[2])
        refused(FitError, torn, method, match="targets 3 and 4 contradict each other.*correct one")
        torn = changed(targets, 3, row=targets.row[2])
        refused(FitError, torn, method, match="targets 3 and 4 contradict each other")
    four = ("k_mm", "k_prime_px", "b_mm", "b_prime_px")
    refused(FitError, targets, free=four, match="both free without sizes.*fix k_mm")
    refused(FitError, targets, free=("k_prime_px", WIDTH_BIAS), match="width_bias_px is free")
    scrambled = Targets(np.random.default_rng(SEED).permutation(targets.row), targets.range_mm)
    refused(FitError, scrambled, match="the targets contradict each other: even")
    refused(FitError, Targets(targets.row[::-1], targets.range_mm), match="no two targets")


def test_a_refusal_names_what_is_wrong():
    targets = posts(size_mm=TWO_SIZES_MM)

    def given(**changes):
        names = ("row", "range_mm", "width_px", "size_mm")
        return Targets(**({name: getattr(targets, name) for name in names} | changes))

    for share in (0.001, 1 / 25.4, 0.5):
        wrong = given(size_mm=TWO_SIZES_MM * share)
        refused(FitError, wrong, match="check width_px and size_mm")
    for share in (1e-3, 1 / 25.4, 0.1, 1e3, 1e6):
        wrong = given(range_mm=targets.range_mm * share, sigma_range_mm=1.0)
        refused(ArgumentError, wrong, match="target [19] is .*give millimetres, 785 to 2116")
    for far in (targets, targets.select([0, 4, 8])):
        alone = "contradict each other, or the design, of which b_mm alone is free"
        with pytest.raises(FitError, match=alone):
            calibrate(far, load_calibration("config_1"), free=("b_mm",))
    same, free = given(column=640.0), ("k_prime_px", "b_prime_px", "b_prime_1_px")
    none = dict.fromkeys(("b_prime_px", "b_prime_1_px"), math.inf)
    refused(FitError, same, free=free, prior_sigma=none, match="give targets in different columns")


def test_one_target_of_a_large_error_does_not_block_the_others():
    targets = posts()
    sigma = np.where(np.arange(9) == 8, 500.0, 1.0)
    found = calibrate(Targets(targets.row, targets.range_mm, 0.3, sigma), NOMINAL)
    assert np.abs(found.fit.model.range_mm(TRUTH.row(NINE_MM[:8])) - NINE_MM[:8]).max() < 4.0


def test_options_that_exclude_each_other_are_refused():
    targets = posts()
    refused(ArgumentError, targets, "paper", free=("b_mm",), match="method paper fits")
    refused(ArgumentError, targets, "paper", prior_sigma={"b_mm": 1.0}, match="no prior_sigma")
    refused(ArgumentError, targets, free=("zoom",), match="free is zoom; name each")
    refused(ArgumentError, targets, prior_sigma={"k_mm": 1.0}, match="prior_sigma names 'k_mm'")
    refused(ArgumentError, targets.select(range(4)), robust=True, match="robust is True with 4")
    assert calibrate(targets.select(range(4)), NOMINAL).used.all()
    assert set(calibrate(targets, NOMINAL).fit.prior_sigma) <= set(PRIOR_SIGMA)


def test_a_prior_far_tighter_than_the_targets_holds_its_parameter():
    """Rounding of the prior's own pull must not keep the search from ending."""
    targets = posts(size_mm=TWO_SIZES_MM)
    tight = {"free": ("k_prime_px", "b_prime_px"), "prior_sigma": {"k_prime_px": 1e-3}}
    report = calibrate(targets, NOMINAL, **tight)
    assert report.fit.model.k_prime_px == pytest.approx(DESIGN.k_prime_px, abs=5e-3)
    assert report.prior_ratio["k_prime_px"] == pytest.approx(1.0, abs=1e-3)


def test_k_alone_has_a_profile_and_a_width_bias_alone_is_no_calibration():
    targets = posts(size_mm=TWO_SIZES_MM)
    report = calibrate(targets, NOMINAL, free=("k_mm",), robust=False)
    assert report.calibration.parameters_fitted == ("k_mm",)
    assert report.profile.delta_chi_square.size == report.profile.k_mm.size
    refused(ArgumentError, targets, free=(WIDTH_BIAS,), match="width_bias_px alone")


def test_a_third_of_hundreds_of_targets_may_be_wrong():
    rng = np.random.default_rng(SEED)
    ranges = np.linspace(800.0, 2090.0, 900)
    row = TRUTH.row(ranges) + rng.normal(0.0, 0.3, 900)
    wrong = rng.random(900) < 0.33
    row[wrong] += rng.choice([-1.0, 1.0], wrong.sum()) * rng.uniform(3.0, 30.0, wrong.sum())
    inside = (row > 0.0) & (row < 719.0)
    report = calibrate(Targets(row, ranges, 0.3, 0.01).select(inside), NOMINAL)
    left_out = {entry.index for entry in report.rejected}
    assert left_out == set(np.flatnonzero(wrong[inside]).tolist())
    ends_mm = report.fit.model.range_mm(TRUTH.row([800.0, 2100.0]))
    assert ends_mm == pytest.approx([800.0, 2100.0], rel=0, abs=0.3)
    assert report.verdicts[0] == "identifiable"
    assert not any("beyond 3 sigma" in line for line in report.verdicts)


def test_sizes_that_contradict_the_k_of_the_papers_method_are_reported():
    other = replace(TRUTH, k_mm=25.0)
    targets = see(np.random.default_rng(SEED), truth=other, size_mm=TWO_SIZES_MM, bloom_px=4.0)
    line = next(v for v in calibrate(targets, NOMINAL, "paper").verdicts if "sizes" in v)
    stated = float(line.split("they give ")[1].split()[0])
    assert stated == pytest.approx(25.0, rel=0.006)
    assert "method joint fits it" in line
    good = see(np.random.default_rng(SEED), truth=DESIGN, size_mm=TWO_SIZES_MM, bloom_px=4.0)
    for method in ("paper", "joint"):
        assert not any("sizes" in v for v in calibrate(good, NOMINAL, method).verdicts)
    assert not any("sizes" in v for v in calibrate(targets, NOMINAL).verdicts)


def on_columns(column, roll_px=0.0):
    """Posts of ALL_ROWS_MM at columns, on a sensor that is rolled."""
    bent = replace(TRUTH, b_prime_1_px=roll_px)
    ranges_mm = np.linspace(840.0, 2000.0, 9)
    row = bent.row(ranges_mm, column) + np.random.default_rng(SEED).normal(0.0, 0.3, 9)
    return Targets(row, ranges_mm, 0.3, 1.0, column=column)


def test_roll_that_the_columns_show_has_a_verdict_with_its_size():
    mixed = np.array([1200.0, 60.0, 640.0, 300.0, 1100.0, 150.0, 900.0, 420.0, 760.0])
    lines = calibrate(on_columns(mixed, 4.0), NOMINAL).verdicts
    line = next(v for v in lines if v.startswith("the sensor is rolled"))
    found_px, sigma_px = map(
        float, re.search(r"b_prime_1_px (\S+) px .*? of (\S+),", line).groups()
    )
    assert abs(found_px - 4.0) < 3.0 * sigma_px < 3.0, f"seed {SEED}"
    assert "identifiable" not in lines
    straight = calibrate(on_columns(mixed), NOMINAL).verdicts
    assert straight[0] == "identifiable"
    assert not [line for line in straight if "roll" in line]


def test_ranges_in_the_order_of_the_columns_leave_roll_out_of_sigma():
    lines = calibrate(on_columns(np.linspace(71.0, 1208.0, 9)), NOMINAL).verdicts
    assert [line for line in lines if line.startswith("sigma leaves out roll and smile")]


@pytest.mark.parametrize("method", ["joint", "paper"])
def test_few_targets_far_from_any_curve_are_refused(method):
    targets = posts(ranges_mm=np.array([840.0, 1100.0, 1500.0, 2000.0]))
    wrong = Targets(targets.row, [840.0, 1100.0, 1500.0, 5000.0], 0.3, 1.0)
    with pytest.raises(FitError, match="times farther from any curve"):
        calibrate(wrong, NOMINAL, method)


def test_the_order_of_the_targets_changes_no_name():
    targets = posts()
    turned = Targets(targets.row[::-1], targets.range_mm[::-1], targets.sigma_row_px[::-1],
                     targets.sigma_range_mm[::-1])  # fmt: skip
    assert calibrate(turned, NOMINAL).calibration.id == calibrate(targets, NOMINAL).calibration.id
