"""What the monitor finds out about the other nodes: their clocks, processes and progress."""

import math
import subprocess
import time

import numpy as np
import pytest
from waiting import wait_until

from eschorty_ros.control.heartbeat import place
from eschorty_ros.control.instrument_monitor import (
    InstrumentMonitor,
    LaserReport,
    ReconstructionStatus,
)
from eschorty_ros.control.paced_waiting import PacedWaiting
from eschorty_ros.control.scan_sequence import ScanFailure


def monitor(**ages_s):
    made = InstrumentMonitor(lambda: True)
    made.update_laser(LaserReport(0, 70.0, 0.5, ""), ages_s.get("laser", 0.01))
    made.update_stage(1, 10.0, 0.0, ages_s.get("stage", 0.01))
    status = ReconstructionStatus(1, 0.0, 0, 0, "", ages_s.get("camera", 0.01))
    made.update_reconstruction(status, ages_s.get("reconstruction", 0.01))
    return made


@pytest.mark.parametrize("name", ["laser", "stage", "camera", "reconstruction"])
@pytest.mark.parametrize(("age_s", "words"), [(-1.0, "1.000 s ahead"), (3600.0, "s behind")])
def test_a_clock_of_another_time_is_named_with_the_difference(name, age_s, words):
    with pytest.raises(ScanFailure, match=f"{name}: its stamps .*{words}.*use_sim_time out"):
        monitor(**{name: age_s}).check_clocks()


def test_late_messages_beside_a_prompt_one_are_no_clock_of_another_time():
    late = monitor(stage=0.9)
    late.update_stage(2, 10.0, 0.0, 0.4)
    late.check_clocks()


def test_a_laser_that_reports_again_has_not_failed():
    subject = monitor()
    subject.update_laser(LaserReport(0, 70.0, 0.5, "not read back"), 0.0)
    subject.laser_failed = True
    with pytest.raises(ScanFailure, match="laser: not read back"):
        subject.check_laser_works()
    subject.update_laser(LaserReport(0, 70.0, 0.5, ""), 0.0)
    subject.check_laser_works()


def test_the_end_of_the_reconstruction_is_found_by_its_process():
    subject = monitor()
    subject.check_reconstruction()
    with subprocess.Popen(["sleep", "60"]) as process:
        subject.update_heartbeat(f"{place()} {process.pid}")
        subject.check_reconstruction()
        process.kill()
    with pytest.raises(ScanFailure, match=f"reconstruction: process {process.pid} is gone"):
        subject.check_reconstruction()


def test_without_progress_the_component_that_lacks_is_named_with_a_remedy():
    lacks = "reconstruction: it does not report for 3 s; check that it runs"
    with pytest.raises(ScanFailure, match=lacks):
        InstrumentMonitor(lambda: True).check_progress(3.0)


def test_a_camera_that_does_not_publish_yet_is_not_said_to_be_gone():
    subject = InstrumentMonitor(lambda: False)
    subject.update_reconstruction(ReconstructionStatus(0, 0.0, 0, 0, "", math.nan), 0.01)
    lacks = "camera: no publisher of camera/events"
    assert subject.cause_of_no_progress().startswith(lacks)
    with pytest.raises(ScanFailure, match=f"{lacks} for 3 s; look at the log of its node"):
        subject.check_progress(3.0)


def test_a_drain_ends_although_there_is_progress():
    subject = monitor()
    waiting = PacedWaiting("scanner", subject, lambda: 10**18, lambda: True, 3.0)

    def advance(phase):
        status = ReconstructionStatus(subject.until_ns + 1, 0.0, 0, 0, "")
        subject.update_reconstruction(status, 0.0)

    waiting.prepare(lambda: False, advance)
    begun_s = time.monotonic()
    with pytest.raises(ScanFailure, match="behind the end of the sweep"):
        waiting.drain(10.0, 0.1)
    assert time.monotonic() - begun_s < 5.0


def test_a_drain_without_any_progress_has_no_pace():
    waiting = PacedWaiting("scanner", monitor(camera=math.nan), lambda: 10**18, lambda: True, 3.0)
    waiting.prepare(lambda: False, lambda phase: None)
    with pytest.raises(ScanFailure, match=r"camera: no events reach the reconstruction for 0\.3 s"):
        waiting.drain(0.3, 0.1)


def test_packets_that_arrive_at_a_busy_reconstruction_are_no_fault_of_the_camera():
    busy = r"reconstruction: packets arrive, but it processes none for 0 s; .* load"
    with pytest.raises(ScanFailure, match=busy):
        monitor().check_progress(0.0)


def test_a_slow_drain_goes_on_while_the_rest_takes_no_longer_than_the_limit():
    subject = monitor()
    waiting = PacedWaiting("scanner", subject, lambda: 10**18, lambda: True, 3.0)
    begun_s = time.monotonic()

    def advance(phase):
        done = (time.monotonic() - begun_s) / 1.3
        until_ns = 10**18 - round(1e9 * max(1.0 - done, 0.0))
        subject.update_reconstruction(ReconstructionStatus(until_ns, 0.0, 0, 0, ""), 0.0)

    advance("")
    waiting.prepare(lambda: False, advance)
    waiting.drain(10.0, 1.0)
    assert subject.until_ns == 10**18


def test_a_stage_is_at_rest_when_its_move_has_had_time_to_end():
    subject = monitor()
    assert subject.at_rest
    subject.update_stage(2, 10.0, 5.0, 0.0)
    subject.update_stage(3, 10.0, 0.0, 0.0)
    assert not subject.at_rest
    wait_until(lambda: subject.at_rest, "the stage at rest")


def test_the_progress_is_where_the_stage_was_at_the_newest_event():
    subject = monitor()
    # Between two scans, however long, none are kept.
    subject.update_stage(20, 6.0, 10.0, 0.0)
    assert not subject.samples
    subject.restart_samples(100)
    # Of the approach, which ended elsewhere, and late.
    subject.update_stage(50, 7.0, 10.0, 0.0)
    assert not subject.samples
    assert np.isnan(subject.reconstructed_mm())
    for t_ns, at_mm in ((100, 1.0), (200, 2.0), (300, 3.0)):
        subject.update_stage(t_ns, at_mm, 10.0, 0.0)
    subject.update_reconstruction(ReconstructionStatus(250, 0.0, 0, 0, ""), 0.0)
    assert subject.reconstructed_mm() == 2.0


def test_a_stall_of_the_scanner_is_not_taken_for_one_of_the_laser(monkeypatch):
    subject = monitor()
    subject.update_laser(LaserReport(1, 70.0, 0.5, ""), 0.0)
    waiting = PacedWaiting("scanner", subject, lambda: 0, lambda: True, 3.0)
    waiting.prepare(lambda: False, lambda phase: None)
    waiting.tick()
    waiting.watch(True)
    waiting.tick()
    stalled_s = time.monotonic() + 6.0
    monkeypatch.setattr(time, "monotonic", lambda: stalled_s)
    with pytest.raises(ScanFailure, match=r"scanner: its process did not run for 6\.0 s"):
        waiting.tick()
    waiting.watch(False)
    waiting.tick()


@pytest.mark.parametrize(
    ("failure", "words"),
    [
        ("laser: no state", "laser: no state within 0 s; check that the node runs"),
        ("laser: it is not active; activate it", "laser: it is not active within 0 s; activate it"),
    ],
)
def test_a_wait_that_ends_in_vain_names_the_remedy(failure, words):
    waiting = PacedWaiting("scanner", monitor(), lambda: 0, lambda: True, 3.0)
    waiting.prepare(lambda: False, lambda phase: None)
    with pytest.raises(ScanFailure, match=words):
        waiting.wait(lambda: False, 0.0, failure)
