"""The steps of a capture: after any failure the laser is off and the collection has ended."""

import math

import pytest
from recording_instrument import RecordingInstrument

from eschorty_ros.control.calibration_sequence import check_request
from eschorty_ros.control.scan_sequence import End, ScanCanceled, ScanFailure
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.calibration import KnownTarget
from eschorty_ros.live.calibration_capture import CaptureRequest, Sweep

TWO = (KnownTarget(1000.0), KnownTarget(1500.0))
RESTING = CaptureRequest(TWO, "joint", 0.5, 70.0)
MOVING = CaptureRequest(TWO[:1], "joint", sweep=Sweep(10.0, 60.0, 20.0, 1.0))


@pytest.mark.parametrize(
    ("request_", "steps"),
    [
        (RESTING, ["begin", "check_nodes", "configure_laser", "laser_on", "collect"]),
        (
            MOVING,
            [
                "begin",
                "check_nodes",
                "configure_laser",
                "stage_limits",
                "move",
                "laser_on",
                "move",
                "move",
            ],
        ),
    ],
)
def test_order_of_a_capture(request_, steps):
    check_request(request_)
    instrument = RecordingInstrument()
    outcome = instrument.capture(request_)
    assert (outcome.end, outcome.message) == (End.SUCCEEDED, "")
    assert instrument.steps() == [*steps, "laser_off", "drain", "finish"]


@pytest.mark.parametrize("step", [("check_nodes", 1), ("configure_laser", 1), ("begin", 1),
                                  ("laser_on", 1), *(("move", k) for k in (1, 2, 3))])  # fmt: skip
@pytest.mark.parametrize("error", [ScanFailure("camera: gone"), ScanCanceled()])
def test_every_interruption_ends_with_the_laser_off_and_at_rest(step, error):
    instrument = RecordingInstrument(step, error)
    outcome = instrument.capture(MOVING)
    canceled = isinstance(error, ScanCanceled)
    assert outcome.end is (End.CANCELED if canceled else End.ABORTED)
    assert outcome.message == ("canceled" if canceled else "camera: gone")
    after = instrument.calls[instrument.calls.index("shield") :]
    assert [n for n in after if n in ("laser_off", "stop_stage")] == ["laser_off", "stop_stage"]
    assert ("finish" in after) == (step[0] != "begin")
    assert "laser_on" not in after
    assert "move" not in after


@pytest.mark.parametrize("step", ["laser_off", "drain", "finish"])
def test_a_failure_on_the_way_out_fails_the_capture_and_the_rest_still_runs(step):
    instrument = RecordingInstrument((step, 1), ScanFailure("laser: no answer"))
    outcome = instrument.capture(RESTING)
    assert (outcome.end, outcome.message) == (End.ABORTED, "laser: no answer")
    # A laser that may still be on does not wait for the last events.
    between = "stop_stage" if step == "laser_off" else "drain"
    assert instrument.steps()[-3:] == ["laser_off", between, "finish"]


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (CaptureRequest(TWO[:1]), "targets holds 1"),
        (CaptureRequest(()), "targets holds 0"),
        (CaptureRequest(TWO, "magic"), "method is 'magic'"),
        (CaptureRequest(TWO, capture_s=0.0), "capture_time is 0 s"),
        (CaptureRequest(TWO, capture_s=math.nan), "capture_time is nan s"),
        (CaptureRequest(TWO, capture_s=1e4), "capture_time is 10000 s"),
        (CaptureRequest(TWO, frequency_hz=5.0), "frequency is 5 Hz"),
        (CaptureRequest(TWO, duty=1.5), "duty is 1.5"),
        (CaptureRequest(TWO, sweep=MOVING.sweep), "with sweep_speed give the one"),
        (CaptureRequest(TWO[:1], sweep=Sweep(0.0, 9.0, 1.0, 0.0)), "range_per_stage is 0"),
        (CaptureRequest(TWO[:1], sweep=Sweep(0.0, 9.0, 1.0, math.nan)), "range_per_stage is nan"),
    ],
)
def test_bad_requests_are_named(request_, words):
    with pytest.raises(ArgumentError, match=words):
        check_request(request_)


@pytest.mark.parametrize(
    ("sweep", "words"),
    [
        (Sweep(-1.0, 9.0, 1.0, 1.0), "sweep_start is -0.001 m; choose 0 to 0.22 m, the stage's"),
        (Sweep(0.0, 221.0, 1.0, 1.0), "sweep_stop is 0.221 m; choose 0 to 0.22 m, the stage's"),
        (Sweep(9.0, 9.0, 1.0, 1.0), "sweep_start and sweep_stop are both 0.009 m"),
        (Sweep(0.0, 9.0, -1.0, 1.0), "sweep_speed is -0.001 m/s"),
        (Sweep(0.0, 9.0, 251.0, 1.0), "sweep_speed is 0.251 m/s"),
        (Sweep(0.0, 9.0, math.nan, 1.0), "sweep_speed is nan m/s"),
    ],
)
def test_a_sweep_that_the_stage_cannot_do_ends_before_it_moves_and_before_light(sweep, words):
    instrument = RecordingInstrument()
    outcome = instrument.capture(CaptureRequest(TWO[:1], sweep=sweep))
    assert outcome.end is End.ABORTED
    assert outcome.message.startswith(words)
    assert not {"move", "laser_on"} & set(instrument.calls)
