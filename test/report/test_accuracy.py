"""Accuracy of a cloud against a scene that is known in closed form."""

import mmap
from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Settings, offline, reconstruct_recording
from eschorty_ros.core.storage import POINT_DTYPE, load_recording
from eschorty_ros.report import accuracy
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world import simulate_recording
from eschorty_ros.surfaces import profiles

MODEL = load_calibration("config_3").model()
PERIOD_S = 1.0 / 70.0
PITCH_MM = 50.0 * PERIOD_S
SWEEP = accuracy.Sweep(-0.5 * PITCH_MM - 0.01, 19.5 * PITCH_MM + 0.01, 50.0, 70.0)


class Wedge:
    """Range grows along the stage; columns from 1000 on see nothing."""

    def range_mm(self, stage_mm, columns, model):
        stage = np.atleast_1d(stage_mm)[:, None]
        column = np.atleast_1d(columns)[None, :]
        return np.where(column < 1000, 1300.0 + 0.5 * stage + 0.01 * column, np.nan)


def cloud(error_mm, direction=(0.0, 1.0, 0.0), lines=20, seed=3):
    """One point per lit column and line, `error_mm` off in range, sigma 0.5 mm."""
    rng = np.random.default_rng(seed)
    line, column = (a.ravel() for a in np.mgrid[0:lines, 0:1000])
    t_s = line * PERIOD_S + rng.normal(0.0, 5e-4, line.size)
    stage = 50.0 * t_s
    true = 1300.0 + 0.5 * stage + 0.01 * column
    range_mm = true + np.broadcast_to(error_mm, line.shape)
    points = np.zeros(line.size, POINT_DTYPE)
    points["x"] = (range_mm + stage * direction[0]) * 1e-3
    points["y"] = stage * direction[1] * 1e-3
    points["z"] = (MODEL.lateral_mm(column, range_mm) + stage * direction[2]) * 1e-3
    points["t"], points["column"], points["sigma"] = t_s, column, 5e-4
    return points


@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.6, 0.8, 0.0), (0.1, -0.98, 0.17)])
def test_exact_points_have_no_error_for_any_stage_direction(direction):
    error = accuracy.range_error_mm(cloud(0.0, direction), Wedge(), MODEL, direction)
    assert np.abs(error).max() < 2e-4  # float32 metres


def test_statistics_of_a_known_error():
    rng = np.random.default_rng(11)
    error = rng.normal(0.2, 0.5, 20_000)
    result = accuracy.measure(cloud(error), Wedge(), MODEL, SWEEP)
    assert (result.periods, result.points, result.completeness) == (20, 20_000, 1.0)
    assert result.error_median_mm == pytest.approx(np.median(np.abs(error)), abs=1e-3)
    assert result.error_p95_mm == pytest.approx(np.percentile(np.abs(error), 95), abs=1e-3)
    assert result.bias_mm == pytest.approx(0.2, abs=0.02)
    assert result.within_1_sigma == pytest.approx(np.mean(np.abs(error) <= 0.5), abs=1e-3)
    assert result.within_2_sigma == pytest.approx(np.mean(np.abs(error) <= 1.0), abs=1e-3)


@pytest.mark.parametrize("back", [False, True])
def test_passes_are_scored_like_one_and_each_counts(back):
    sweep = accuracy.Sweep(*(SWEEP.stop_mm, SWEEP.start_mm), 50.0, 70.0, 3) if back else replace(
        SWEEP, passes=3
    )  # fmt: skip
    parts = [cloud(0.3, seed=seed) for seed in range(3)]
    for number, part in enumerate(parts):
        if (number % 2 == 1) != back:
            part["t"] = 19 * PERIOD_S - part["t"]
        part["t"] += number * 25 * PERIOD_S
    points = np.concatenate(parts)
    rng = np.random.default_rng(5)
    points = points[rng.permutation(len(points))]
    expected = np.rint(points["t"] / PERIOD_S).astype(int) // 25
    np.testing.assert_array_equal(accuracy.pass_index(points, sweep), expected)
    result = accuracy.measure(points, Wedge(), MODEL, sweep)
    assert (result.periods, result.completeness) == (60, 1.0)
    assert result.error_median_mm == pytest.approx(0.3, abs=1e-3)
    first = points[expected == 0]
    without = accuracy.measure(first, Wedge(), MODEL, replace(sweep, passes=2))
    assert (without.periods, without.completeness) == (40, 0.5)


def test_points_where_the_scene_is_empty_are_counted_not_measured():
    points = cloud(0.0)
    points["column"][:50] = 1100
    result = accuracy.measure(points, Wedge(), MODEL, SWEEP)
    assert result.off_target == 50
    assert result.completeness == pytest.approx(19_950 / 20_000)
    assert result.error_p95_mm < 2e-4


def test_a_missing_point_lowers_the_completeness_and_a_second_one_of_a_column_fills_no_gap():
    points = cloud(0.0)
    assert accuracy.measure(points[::2], Wedge(), MODEL, SWEEP).completeness == 0.5
    points[100:200] = points[:100]
    assert accuracy.measure(points, Wedge(), MODEL, SWEEP).completeness == 0.995


def test_points_of_a_column_lit_for_part_of_a_period_complete_nothing_else():
    class Corner(Wedge):
        """Columns below 100 see nothing just after the middle of each period."""

        def range_mm(self, stage_mm, columns, model):
            stage = np.atleast_1d(stage_mm)[:, None]
            late = np.mod(stage / PITCH_MM, 1.0) > 0.05
            hidden = (np.atleast_1d(columns)[None, :] < 100) & ~late
            return np.where(hidden, np.nan, super().range_mm(stage_mm, columns, model))

    assert accuracy.measure(cloud(0.0), Corner(), MODEL, SWEEP).completeness <= 1.0


def test_columns_out_of_the_sensors_view_are_not_expected():
    class Far:
        def range_mm(self, stage_mm, columns, model):
            return np.full((np.size(stage_mm), np.size(columns)), 5000.0)

    lit = accuracy.lit_columns(Far(), MODEL, np.zeros(3))
    assert lit.shape == (3, MODEL.columns)
    assert not lit.any()


def test_a_bent_line_is_on_the_sensor_where_its_own_column_is():
    bent = replace(load_calibration("config_3"), b_prime_1_px=15.0, b_prime_2_px=5.0).model()
    near_mm = bent.range_limits_mm[0]

    class Near:
        def range_mm(self, stage_mm, columns, model):
            return np.full((np.size(stage_mm), np.size(columns)), near_mm + 5.0)

    lit = accuracy.lit_columns(Near(), bent, np.zeros(1))[0]
    row = bent.row(np.full(bent.columns, near_mm + 5.0), np.arange(bent.columns))
    np.testing.assert_array_equal(lit, (row >= 0.0) & (row <= bent.rows - 1.0))
    assert 0 < np.count_nonzero(lit) < bent.columns


def test_an_empty_cloud_gives_nan_not_a_crash():
    result = accuracy.measure(np.empty(0, POINT_DTYPE), Wedge(), MODEL, SWEEP)
    assert (result.points, result.completeness) == (0, 0.0)
    assert np.isnan(result.error_median_mm)


def test_a_stage_that_moves_within_the_sheet_is_refused():
    with pytest.raises(ArgumentError, match="stage_direction"):
        accuracy.stage_and_range_mm(cloud(0.0), (1.0, 0.0, 0.0))


@pytest.mark.parametrize("backwards", [False, True])
def test_periods_that_the_ends_cut_do_not_count(backwards):
    points = cloud(0.0)
    ends = (0.3 * PITCH_MM, 10.3 * PITCH_MM)
    sign = -1.0 if backwards else 1.0
    points["y"] *= sign
    sweep = accuracy.Sweep(sign * ends[0], sign * ends[1], 50.0, 70.0)
    positions, number = accuracy.complete_periods(points, sweep)
    np.testing.assert_allclose(np.abs(positions), np.arange(1, 10) * PITCH_MM, atol=0.01)
    assert np.bincount(number[number >= 0]).tolist() == [1000] * 9


def test_periods_without_any_point_count_as_missing():
    points = cloud(0.0)
    line = np.rint(points["t"] / PERIOD_S)
    result = accuracy.measure(points[(line != 7) & (line > 1)], Wedge(), MODEL, SWEEP)
    assert result.periods == 20
    assert result.completeness == pytest.approx(17 / 20)


def test_profiles_of_several_periods_count_as_one():
    points = cloud(0.0)
    line = np.rint(points["t"] / PERIOD_S)
    # Their events come in any of the four.
    moved_s = np.random.default_rng(6).uniform(-1.5, 1.5, line.size) * PERIOD_S
    points["t"] += moved_s
    points["y"] += 50e-3 * moved_s
    result = accuracy.measure(points[line % 4 == 2], Wedge(), MODEL, SWEEP)
    # The end of the sweep cuts the fifth.
    assert (result.periods, result.completeness) == (4, 1.0)


def test_a_sweep_has_a_speed():
    with pytest.raises(ArgumentError, match="speed_mm_s"):
        accuracy.Sweep(0.0, 1.0, 0.0, 70.0)
    assert accuracy.Sweep(10.0, 0.0, 50.0, 100.0).pitch_mm == -0.5


def test_periods_are_recovered_from_the_points_alone():
    points = cloud(0.0, lines=300)
    rng = np.random.default_rng(5)
    keep = rng.random(len(points)) < 0.7
    keep &= ~((points["t"] > 1.0) & (points["t"] < 1.3))
    points = rng.permutation(points[keep])
    period = profiles.period_s(points)
    assert period == pytest.approx(PERIOD_S, rel=1e-4)
    index = profiles.profile_index(points, period)
    np.testing.assert_array_equal(index, np.rint(points["t"] / PERIOD_S))


def test_two_returns_of_a_column_belong_to_one_period():
    rng = np.random.default_rng(5)
    points = np.concatenate([cloud(0.0, lines=40)] * 2)
    truth = np.rint(points["t"] / PERIOD_S)
    points["t"] += rng.normal(0.0, 0.004 * PERIOD_S, len(points))
    period = profiles.period_s(points)
    assert period == pytest.approx(PERIOD_S, rel=1e-4)
    np.testing.assert_array_equal(profiles.profile_index(points, period), truth)


def test_a_single_profile_has_no_period():
    assert np.isnan(profiles.period_s(cloud(0.0, lines=1)))
    with pytest.raises(ArgumentError, match="period"):
        profiles.profile_index(cloud(0.0, lines=1), float("nan"))


@pytest.mark.parametrize("scene", ["steps", "tilted", "leaves"])
def test_a_recorded_truth_scores_as_its_scene_does(tmp_path, scene):
    narrow = replace(load_calibration("config_3"), columns=96, principal_column=None)
    recording = simulate_recording(tmp_path, named(scene), narrow, stop_mm=40.0, seed=8)
    found = reconstruct_recording(recording)
    scored = accuracy.measure_recorded(found.points, found.profiles, recording)
    sweep = accuracy.Sweep(10.0, 40.0, 50.0, 70.0)
    known = accuracy.measure(found.points, named(scene), narrow.model(), sweep)
    assert scored.points == known.points > 1000
    assert scored.completeness == pytest.approx(known.completeness, abs=2e-3)
    # A recorded truth knows nothing of the profile before its first period.
    edge = narrow.columns + 0.01 * known.points
    assert scored.off_target == pytest.approx(known.off_target, abs=edge)
    for name in ("error_median_mm", "error_p95_mm", "within_1_sigma", "within_2_sigma"):
        assert getattr(scored, name) == pytest.approx(getattr(known, name), rel=0.02), name
    # Where the truth has ended no point is off target.
    part = replace(recording)
    times = np.unique(recording.truth["t_us"])
    part.__dict__["truth"] = recording.truth[recording.truth["t_us"] < times[len(times) // 2]]
    halved = accuracy.measure_recorded(found.points, found.profiles, part)
    assert halved.off_target <= scored.off_target
    assert halved.periods == len(times) // 2
    longer = reconstruct_recording(recording, Settings(periods_per_profile=4))
    by_four = accuracy.measure_recorded(longer.points, longer.profiles, recording)
    assert by_four.periods == pytest.approx(scored.periods / 4, abs=1)
    assert by_four.completeness == pytest.approx(scored.completeness, abs=0.1)
    (tmp_path / "truth.csv").unlink()
    bare = load_recording(tmp_path)
    assert accuracy.measure_recorded(found.points, found.profiles, bare) is None


def test_points_in_a_file_are_those_in_memory(tmp_path, monkeypatch):
    """Also where a profile ends in a later piece of the file."""
    monkeypatch.setattr(offline, "_PASS_BYTES", mmap.PAGESIZE)
    narrow = replace(load_calibration("config_3"), columns=24, principal_column=None)
    recording = simulate_recording(tmp_path, named("steps"), narrow, stop_mm=14.0, seed=8)
    for name in ("with_truth", "without"):
        (tmp_path / name).mkdir()
        settings = Settings(organized="on")
        memory = reconstruct_recording(recording, settings, jobs=1)
        file = reconstruct_recording(recording, settings, jobs=1, folder=tmp_path / name)
        assert file.profile_count == memory.profile_count > 5
        assert file.points.tobytes() == memory.points.tobytes()
        assert file.organized.tobytes() == memory.organized.tobytes()
        assert file.organized.shape == memory.organized.shape
        assert len(file.profiles) == (len(memory.profiles) if name == "with_truth" else 0)
        (tmp_path / "truth.csv").unlink(missing_ok=True)


@pytest.mark.parametrize("back", [False, True])
def test_the_truth_of_a_recorded_scan_is_the_scene_at_its_periods(tmp_path, back):
    """The simulation's own truth has the middle of the lit phase; events are some ms around it."""
    ends = np.array([21.0, 11.0] if back else [11.0, 21.0])
    scene = named("steps")
    recording = simulate_recording(
        tmp_path, scene, load_calibration("config_3"), start_mm=ends[0], stop_mm=ends[1], seed=2
    )
    points = reconstruct_recording(recording).points
    # Without the ramps.
    sweep = accuracy.Sweep(*np.clip(ends, 12.0, 20.0), 50.0, 70.0)
    truth = accuracy.recorded_truth(points, scene, recording, sweep)
    times = np.unique(truth["t_us"])
    assert len(times) == accuracy.measure(points, scene, MODEL, sweep).periods >= 10
    assert np.abs(np.diff(times) * 1e-6 - PERIOD_S).max() < 1e-4
    known = np.unique(recording.truth["t_us"])
    apart = np.abs(times[:, None] - known).min(axis=1)
    assert apart.max() < 3000
    stage_mm = recording.stage.position_mm(times)
    expected = scene.range_mm(stage_mm, np.arange(1280), MODEL)
    np.testing.assert_allclose(truth["range_mm"], expected[np.isfinite(expected)], atol=0.01)
    # A stage that has crossed the sweep before, on its way to the start.
    samples = recording.stage_samples
    way = np.linspace(*(ends if back else ends[::-1]), 50)
    approach = np.zeros(50, samples.dtype)
    approach["t_us"], approach["position_mm"] = np.arange(50) * 1000, way[::-1] if back else way
    samples = samples.copy()
    approach["t_us"] += samples["t_us"][0] - 50_000
    later = replace(recording, stage_samples=np.concatenate([approach, samples]))
    np.testing.assert_array_equal(accuracy.recorded_truth(points, scene, later, sweep), truth)
