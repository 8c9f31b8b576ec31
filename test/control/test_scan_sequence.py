"""The steps of a scan: after any failure the laser is off, the stage rests, points are kept."""

import math
from dataclasses import replace

import pytest
from recording_instrument import FOLDER, LIMITS, RecordingInstrument

from eschorty_ros.control.scan_sequence import (
    End,
    ScanCanceled,
    ScanFailure,
    ScanRequest,
    ScanSettings,
    ScanSummary,
    SweepProgress,
    check_request,
    crossing_ns,
    run_scan,
    sweep_ends_mm,
)
from eschorty_ros.core.base.errors import ArgumentError

SETTINGS = ScanSettings(100.0, 10.0)
REQUEST = ScanRequest("s", 20.0, 40.0, 50.0, 70.0)
STEPS = ("check_nodes", "stage_limits", "configure_laser", "move", "begin_scan", "laser_on", "move")


def test_order_of_a_scan():
    instrument = RecordingInstrument()
    outcome = run_scan(instrument, REQUEST, SETTINGS)
    assert (outcome.end, outcome.message, outcome.summary.points) == (End.SUCCEEDED, "", 5)
    assert instrument.steps() == [*STEPS, "laser_off", "drain", "end_scan"]


def test_a_scan_beyond_the_limits_that_the_stage_publishes_ends_before_it_moves():
    short, slow = (replace(LIMITS, **change) for change in
                   ({"travel_mm": (0.0, 30.0)}, {"speed_max_mm_s": 60.0}))  # fmt: skip
    instrument = RecordingInstrument()
    instrument.stage_limits = lambda: short
    outcome = run_scan(instrument, REQUEST, SETTINGS)
    assert outcome.end is End.ABORTED
    assert outcome.message.startswith("stop is 0.04 m; choose 0 to 0.03 m")
    assert not {"move", "laser_on"} & set(instrument.calls)
    instrument, moves = RecordingInstrument(), []
    instrument.stage_limits, instrument.move = lambda: slow, lambda *values: moves.append(values)
    assert run_scan(instrument, REQUEST, SETTINGS).end is End.SUCCEEDED
    assert [speed_mm_s for _, speed_mm_s in moves] == [60.0, 50.0]


def test_passes_go_forth_and_back_under_one_light():
    instrument, moves = RecordingInstrument(), []
    request = replace(REQUEST, passes=3)
    instrument.move = lambda *values: moves.append(values)
    assert run_scan(instrument, request, SETTINGS).end is End.SUCCEEDED
    begin, end = sweep_ends_mm(request, LIMITS)
    assert moves == [(begin, SETTINGS.approach_mm_s), (end, 50.0), (begin, 50.0), (end, 50.0)]
    assert instrument.calls.count("laser_on") == instrument.calls.count("end_scan") == 1
    progress = SweepProgress(replace(request, passes=2))
    shares = [progress.share("sweeping", at_mm) for at_mm in (18.0, 30.0, 41.0, 30.0, 18.0)]
    assert shares == [0.0, 0.25, 0.5, 0.75, 1.0]
    progress = SweepProgress(REQUEST)
    lagging = [("to_start", 20.0), ("sweeping", 20.0), ("sweeping", 25.0), ("finishing", 25.0)]
    assert [progress.share(*at) for at in lagging] == [0.0, 0.0, 0.25, 0.25]
    assert progress.share("finishing", 40.0) == 1.0


def test_points_of_the_way_to_the_start_and_beyond_the_stop_are_not_counted():
    progress = SweepProgress(REQUEST)
    totals = [
        (math.nan, 0),
        (18.0, 500),
        (19.0, 1500),
        (21.0, 3500),
        (40.0, 22_500),
        (42.0, 24_500),
    ]
    counts = [progress.counts(at_mm, points, points // 100) for at_mm, points in totals]
    assert counts == [(0, 0), (0, 0), (0, 0), (1000, 10), (20_000, 200), (20_000, 200)]
    # Another reconstruction.
    assert progress.counts(30.0, 10, 0) == (20_000, 200)


@pytest.mark.parametrize("step", [("check_nodes", 1), ("configure_laser", 1), ("move", 1),
                                  ("begin_scan", 1), ("laser_on", 1), ("move", 2)])  # fmt: skip
@pytest.mark.parametrize("error", [ScanFailure("stage: stuck"), ScanCanceled()])
def test_every_interruption_ends_with_the_laser_off_and_at_rest(step, error):
    instrument = RecordingInstrument(step, error)
    outcome = run_scan(instrument, REQUEST, SETTINGS)
    canceled = isinstance(error, ScanCanceled)
    assert outcome.end is (End.CANCELED if canceled else End.ABORTED)
    assert outcome.message == ("canceled" if canceled else "stage: stuck")
    after = instrument.calls[instrument.calls.index("shield") :]
    assert [n for n in after if n in ("laser_off", "stop_stage")] == ["laser_off", "stop_stage"]
    assert "move" not in after
    begun = step in (("laser_on", 1), ("move", 2))
    assert ("end_scan" in after) == begun
    assert outcome.summary.points == (5 if begun else 0)


@pytest.mark.parametrize("step", ["laser_off", "drain", "end_scan"])
def test_a_failure_on_the_way_out_fails_the_scan_and_the_rest_still_runs(step):
    instrument = RecordingInstrument((step, 1), ScanFailure("laser: no answer"))
    outcome = run_scan(instrument, REQUEST, SETTINGS)
    assert outcome.end is End.ABORTED
    assert outcome.message.startswith("laser: no answer")
    steps = [name for name in instrument.steps() if name != "stop_stage"]
    assert steps[-3:] == ["laser_off", "drain", "end_scan"]


def test_any_error_of_switching_the_laser_off_leaves_the_stage_at_rest():
    instrument = RecordingInstrument(("move", 2), ScanFailure("stage: stuck"))

    def laser_off():
        raise RuntimeError("the context has ended")

    instrument.laser_off = laser_off
    with pytest.raises(RuntimeError, match="the context has ended"):
        run_scan(instrument, REQUEST, SETTINGS)
    assert instrument.calls[-1] == "stop_stage"


def test_the_first_reason_stays():
    instrument = RecordingInstrument(("move", 2), ScanFailure("camera: gone"))

    def end_scan(scan_id, reason):
        raise ScanFailure("reconstruction: gone")

    instrument.end_scan = end_scan
    assert run_scan(instrument, REQUEST, SETTINGS).message.startswith("camera: gone")


def test_a_reconstruction_that_has_ended_leaves_its_recording_with_the_remedy():
    gone = ScanFailure("reconstruction: process 7 is gone; the scan ends")
    outcome = run_scan(RecordingInstrument(("end_scan", 1), gone), REQUEST, SETTINGS)
    assert outcome.message == (
        f"{gone}; `eschorty reconstruct '{FOLDER}'` makes points of what was recorded until then"
    )
    assert outcome.summary.recording == FOLDER


def test_a_reconstruction_that_ends_before_its_first_packet_leaves_nothing_to_reconstruct(tmp_path):
    gone = ScanFailure("reconstruction: process 7 is gone; the scan ends")
    instrument = RecordingInstrument(("end_scan", 1), gone)
    instrument.begin_scan = lambda request: str(tmp_path)
    message = run_scan(instrument, REQUEST, SETTINGS).message
    assert message == f"{gone}; no packet had come, so there is nothing to reconstruct"
    (tmp_path / "events.raw").touch()
    instrument = RecordingInstrument(("end_scan", 1), gone)
    instrument.begin_scan = lambda request: str(tmp_path)
    assert f"`eschorty reconstruct {tmp_path}`" in run_scan(instrument, REQUEST, SETTINGS).message


def test_the_reason_of_an_early_end_reaches_the_recording():
    instrument, ends = RecordingInstrument(("move", 2), ScanFailure("camera: gone")), []
    instrument.end_scan = lambda *values: ends.append(values) or ScanSummary(points=5)
    run_scan(instrument, REQUEST, SETTINGS)
    assert ends == [(REQUEST.scan_id, "camera: gone")]


@pytest.mark.parametrize(
    ("summary", "end", "line"),
    [
        (ScanSummary(points=5, completeness=1.0), End.SUCCEEDED, "complete"),
        (
            ScanSummary(points=5, completeness=0.95, packets_lost=2, message="2 packets lost"),
            End.SUCCEEDED,
            "partial, 95.0%: 2 packets lost",
        ),
        (
            ScanSummary(points=5, completeness=0.12, message="17 profiles of 140"),
            End.ABORTED,
            "partial, 12.0%: 17 profiles of 140",
        ),
        (ScanSummary(completeness=1.0, message="no points"), End.ABORTED, "failed: no points"),
    ],
)
def test_a_scan_without_its_points_is_no_success(summary, end, line):
    instrument = RecordingInstrument(summary=summary)
    outcome = run_scan(instrument, REQUEST, SETTINGS)
    assert outcome.end is end
    assert outcome.summary.line == line


def test_run_up_gives_constant_speed_between_start_and_stop_within_travel():
    begin, end = sweep_ends_mm(REQUEST, LIMITS)
    ramp = 50.0**2 / (2 * 2000.0)
    assert begin < 20.0 - ramp < 40.0 + ramp < end
    assert sweep_ends_mm(ScanRequest("s", 40.0, 20.0, 50.0), LIMITS) == (end, begin)
    assert sweep_ends_mm(ScanRequest("s", 0.0, 220.0, 50.0), LIMITS) == (0.0, 220.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"start_mm": -1.0}, "start is -0.001 m"),
        ({"stop_mm": 221.0}, "stop is 0.221 m"),
        ({"stop_mm": math.nan}, "stop is nan m"),
        ({"speed_mm_s": 0.0}, "speed is 0 m/s"),
        ({"speed_mm_s": math.inf}, "speed is inf m/s"),
        ({"frequency_hz": 15.9}, "frequency is 15.9 Hz"),
        ({"duty": 1.0}, "duty is 1"),
        ({"passes": 256}, "passes is 256"),
        ({"stop_mm": 20.5, "frequency_hz": 70.0}, "start to stop is 0.0005 m, less than the"),
    ],
)
def test_bad_requests_are_named(change, words):
    values = {"scan_id": "s", "start_mm": 20.0, "stop_mm": 40.0, "speed_mm_s": 50.0}
    with pytest.raises(ArgumentError, match=words):
        check_request(ScanRequest(**{**values, **change}), LIMITS)


def test_crossing_time_is_interpolated_either_way():
    samples = [(0, 0.0), (10, 0.0), (20, 10.0), (30, 20.0)]
    assert [crossing_ns(samples, at_mm) for at_mm in (5.0, 20.0, 21.0)] == [15, 30, None]
    assert crossing_ns([(t, -p) for t, p in samples], -5.0) == 15
