"""Placing profiles by time, and assembling a scan."""

import numpy as np
import pytest
from line_events import blank_profiles

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE
from eschorty_ros.live.pipeline import ScanReport
from eschorty_ros.live.scan_buffer import PlacedPoints, ScanBuffer
from eschorty_ros.live.sensor_epoch import TimedProfiles
from eschorty_ros.live.stage_placement import StagePlacer

T0_NS = 1_700_000_000_000_000_123
CALIBRATION = load_calibration("config_3")


def placed(stage_mm, edge_ns, columns, dtype=POINT_DTYPE):
    points = np.zeros(len(columns), dtype)
    points["column"], points["sigma"] = columns, 1e-3
    edges = np.asarray(edge_ns, dtype=np.int64)
    return PlacedPoints(points, edges + 10, edges, np.asarray(stage_mm, dtype=float))


def timed(t_ns):
    t_ns = np.asarray(t_ns, dtype=np.int64)
    build = CALIBRATION.model(), CALIBRATION.stage_direction
    return TimedProfiles(blank_profiles(len(t_ns)), t_ns, t_ns, *build)


def following(samples_ms):
    placer = StagePlacer(gap_s=0.5, timeout_s=1.0)
    for t_ms, position_mm in samples_ms:
        placer.add_stage(T0_NS + t_ms * 1_000_000, position_mm)
    return placer


def test_reflectance_asked_for_in_the_middle_of_a_scan_is_nan_before():
    buffer = ScanBuffer("a", 0.0, 20.0)
    buffer.add(placed([10.0], [T0_NS], [7]))
    buffer.add(placed([15.0], [T0_NS + 1000], [9], REFLECTANCE_DTYPE))
    points = buffer.assemble().points
    assert points.dtype == REFLECTANCE_DTYPE
    assert np.isnan(points["reflectance"]).tolist() == [True, False]
    assert points["column"].tolist() == [7, 9]


def test_scan_is_sorted_by_period_then_column_and_limits_are_included():
    buffer = ScanBuffer("a", 20.0, 10.0)
    buffer.add(placed([10.0, 20.0, 9.99, 20.01], [T0_NS, T0_NS, T0_NS, T0_NS], [7, 3, 1, 2]))
    buffer.add(placed([15.0], [T0_NS - 1000], [9]))
    scan = buffer.assemble()
    assert scan.points["column"].tolist() == [9, 3, 7]
    assert scan.profiles == 2
    assert scan.stamp_ns == T0_NS - 990
    np.testing.assert_allclose(scan.points["t"], [0.0, 1e-6, 1e-6], atol=1e-15)
    assert scan.sigma_median_m == pytest.approx(1e-3)


def test_empty_scan():
    scan = ScanBuffer("a", 0.0, 1.0).assemble()
    assert len(scan.points) == scan.profiles == 0


def test_points_outside_the_limits_are_counted():
    buffer = ScanBuffer("a", 0.0, 1.0)
    buffer.add(placed([-0.1, 0.5, 1.1, 2.0], [T0_NS] * 4, [1, 2, 3, 4]))
    assert len(buffer.assemble().points) == 1
    assert buffer.points_outside == 3


@pytest.mark.parametrize(
    ("points", "events", "without", "outside", "expected", "begins"),
    [
        (5, 100, 0, 3, 1, ""),
        (0, 0, 0, 0, 1, "no points: the cause"),
        (0, 100, 0, 0, 1, "no points: the cause"),
        (0, 100, 0, 3, 1, "no points: all 3 are outside start to stop"),
        (0, 100, 0, 3, 0, "no points: the stage has not moved by a profile between"),
        (0, 100, 7, 3, 1, "7 points had no stage position"),
    ],
)
def test_a_scan_without_points_has_the_reason(points, events, without, outside, expected, begins):
    buffer = ScanBuffer("a", 0.0, 1.0)
    if points:
        buffer.add(placed([0.5] * points, [T0_NS] * points, range(points)))
    counts = events, 1, 0, 0, without, outside, 0, expected
    report = ScanReport(buffer.assemble(), *counts, "the cause")
    assert report.message.startswith(begins)
    assert bool(report.message) == bool(begins)
    assert (report.completeness > 0.0) == bool(points)


def test_a_scan_without_points_has_the_warnings_of_the_stream_for_a_reason():
    empty = ScanBuffer("a", 0.0, 1.0).assemble()
    report = ScanReport(empty, 100, 1, 0, 0, 0, 0, 0, 1, "", ("widen range_min", "look here"))
    assert report.message == "no points: widen range_min; look here"


@pytest.mark.parametrize(
    ("profiles", "possible", "surplus"),
    [(97, 100, False), (104, 100, False), (190, 200, False), (190, 100, True), (120, 100, True)],
)
def test_more_profiles_than_the_stages_time_allows_are_named(profiles, possible, surplus):
    buffer = ScanBuffer("a", 0.0, 1.0)
    buffer.add(placed([0.5] * profiles, T0_NS + 1_000_000 * np.arange(profiles), range(profiles)))
    counts = 1000, 1, 0, 0, 0, 0, 0, 97
    report = ScanReport(buffer.assemble(), *counts, "the cause", profiles_max=possible)
    assert (report.completeness < 0.9) == surplus
    assert (f"{profiles} profiles of 100 between start and stop, more" in report.message) == surplus
    assert bool(report.message) == surplus


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ({"profiles_max": 12}, "the stage was there only for as long as 12 take"),
        ({"periods_empty": 80}, "80 periods had no events; check that light falls"),
        ({"events_dropped": 7}, "7 events were dropped; lower"),
        ({"packets_lost": 3}, "3 packets were lost; look at the computer's load"),
        ({"profiles_max": 100, "periods_empty": 5}, "10 profiles of 100 between start and stop"),
    ],
)
def test_a_scan_with_few_profiles_names_the_cause(counts, words):
    buffer = ScanBuffer("a", 0.0, 1.0)
    buffer.add(placed([0.5] * 10, T0_NS + 1_000_000 * np.arange(10), range(10)))
    names = ("events", "packets", "packets_lost", "events_dropped", "points_without_stage",
             "points_outside", "points_over_limit", "profiles_expected")  # fmt: skip
    known = dict(zip(names, (1000, 100, 0, 0, 0, 4, 0, 100), strict=True))
    message = ScanReport(buffer.assemble(), cause_of_no_points="", **{**known, **counts}).message
    assert words in message
    causes = ("the stage was there", "no events", "were dropped", "were lost")
    assert [cause for cause in causes if cause in message] == [c for c in causes if c in words]


def test_points_of_before_the_scan_are_left_out_and_counted():
    buffer = ScanBuffer("a", 0.0, 1.0, since_ns=T0_NS)
    buffer.add(placed([0.5, 0.5, 0.5], [T0_NS - 1, T0_NS, T0_NS + 1], [1, 2, 3]))
    assert len(buffer.assemble().points) == 2
    assert buffer.points_outside == 1


def test_points_over_the_limit_are_counted():
    buffer = ScanBuffer("a", 0.0, 1.0, points_max=3)
    for _ in range(2):
        buffer.add(placed([0.5, 0.5], [T0_NS, T0_NS], [1, 2]))
    assert len(buffer.assemble().points) == 3
    assert buffer.points_over_limit == 1


@pytest.mark.parametrize("limits", [(np.nan, 1.0), (0.0, np.inf)])
def test_limits_must_be_finite(limits):
    with pytest.raises(ArgumentError, match="not finite"):
        ScanBuffer("a", *limits)


def test_points_wait_for_the_stage_and_are_never_extrapolated():
    placer = StagePlacer(gap_s=0.0, timeout_s=1.0)
    placer.add_profiles(timed([T0_NS - 1_000_000, T0_NS + 500_000, T0_NS + 2_000_000]), 0.0)
    assert placer.ready(0.1) == []
    placer.add_stage(T0_NS, 10.0)
    placer.add_stage(T0_NS + 1_000_000, 11.0)
    # Those that came together wait for the last of them.
    assert placer.ready(0.2) == []
    assert (placer.points_without_stage, placer.waiting) == (0, 3)
    ((part, position_mm),) = placer.ready(1.5)
    assert part.t_ns.tolist() == [T0_NS + 500_000]
    np.testing.assert_allclose(position_mm, [10.5])
    # The first was before the stage's first sample, the last after its newest.
    assert (placer.points_without_stage, placer.waiting) == (2, 0)


def test_profiles_of_the_background_after_the_end_delay_no_scan():
    placer = StagePlacer(gap_s=0.0, timeout_s=10.0)
    placer.add_profiles(timed([T0_NS + 500_000]), 0.0)
    placer.add_profiles(timed([T0_NS + 2_000_000]), 1.0)
    assert placer.holds(0.5)
    placer.add_stage(T0_NS, 10.0)
    placer.add_stage(T0_NS + 1_000_000, 11.0)
    placer.ready(1.1)
    assert placer.waiting == 1
    assert not placer.holds(0.5)
    assert placer.holds(1.0)


def test_a_gap_in_the_odometry_is_not_bridged():
    placer = following([(0, 10.0), (2000, 12.0)])
    placer.add_profiles(timed([T0_NS + 1_000_000_000]), 0.0)
    assert placer.ready(0.0) == []
    assert placer.points_without_stage == 1


@pytest.mark.parametrize("back_s", [1, 3600])
def test_odometry_of_a_clock_set_back_places_by_itself_alone(back_s):
    """A recording played again or a host clock set back: old positions are wrong."""
    again_ms = 4_990 - back_s * 1000
    again = [(again_ms + 10 * k, 7.0) for k in range(20)]
    placer = following([(10 * k, 0.1 * k) for k in range(500)] + again)
    placer.add_profiles(timed([T0_NS + (again_ms + 55) * 1_000_000]), 0.0)
    ((part, position_mm),) = placer.ready(0.0)
    assert position_mm.tolist() == [7.0]
    assert len(part.t_ns) == 1
    assert (placer.track_restarts, placer.late_samples) == (1, 0)


def test_an_odometry_sample_a_little_late_is_left_out():
    placer = following([(0, 0.0), (10, 1.0), (9, 50.0), (20, 2.0)])
    placer.add_profiles(timed([T0_NS + 15_000_000]), 0.0)
    ((_, position_mm),) = placer.ready(0.0)
    np.testing.assert_allclose(position_mm, [1.5])
    assert (placer.track_restarts, placer.late_samples) == (0, 1)
