"""The profiles that a sweep should give."""

import numpy as np
import pytest

from eschorty_ros.live.sweep_coverage import SweepCoverage


def swept(positions_mm, start_mm=20.0, stop_mm=40.0, passes=1):
    coverage = SweepCoverage(start_mm, stop_mm, passes)
    for k, position_mm in enumerate(positions_mm):
        coverage.add(k * 10_000_000, float(position_mm))
    return coverage.profiles(70.0)


@pytest.mark.parametrize("back", [False, True])
def test_profiles_of_a_sweep_with_run_up_and_rest_inside(back):
    rng = np.random.default_rng(1)
    rest = 20.5 + 1e-4 * rng.standard_normal(300)
    ramp = 20.5 + 0.5 * np.arange(30) ** 2 / 60
    sweep = np.arange(ramp[-1], 45.0, 0.5)
    positions = np.concatenate([rest, ramp, sweep])
    assert swept(60.0 - positions if back else positions) == 27


def test_a_part_of_a_sweep_counts_for_the_whole():
    assert swept(np.arange(10.0, 25.0, 0.5)) == 27


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_every_pass_counts_also_one_that_is_missing(turns):
    there = np.arange(10.0, 50.0, 0.5)
    way = np.concatenate([there[:: (-1) ** k] for k in range(turns)])
    assert swept(way, passes=2) == 2 * 27


def test_a_late_sample_does_not_count():
    coverage = SweepCoverage(20.0, 40.0)
    for k, position_mm in enumerate(np.arange(10.0, 45.0, 0.5)):
        coverage.add(k * 10_000_000 + (k > 40) * 5_000_000_000, float(position_mm))
    assert coverage.profiles(70.0) == 27


def test_no_motion_gives_no_profiles():
    assert swept([30.0] * 50) == swept([]) == 0


def test_the_most_profiles_are_those_of_the_time_inside_with_rests():
    coverage = SweepCoverage(20.0, 40.0)
    rests = [10.0] * 100, np.arange(10.0, 30.0, 0.5), [30.0] * 101, np.arange(30.5, 50.0, 0.5)
    for k, position_mm in enumerate(np.concatenate(rests)):
        coverage.add(k * 10_000_000, float(position_mm))
    # 0.4 s of motion and 1 s of rest.
    assert coverage.profiles_max(70.0) == pytest.approx(1.4 * 70, abs=1)
    assert coverage.profiles(70.0) == 27
