"""Scans recorded while they run: the same points again, whatever the disk does."""

import resource
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import recorded_scan
from recorded_scan import LiveScan
from waiting import DEADLINE_S

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.core.storage import ScanLog, load_recording, read_cloud
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.core.storage.recording import MARK_DTYPE
from eschorty_ros.core.storage.recording_writer import RecordingWriter, make_recording_folder
from eschorty_ros.live import scan_recorder
from eschorty_ros.live.recorded_packets import timed_packets
from eschorty_ros.live.scan_recorder import ScanRecorder

SQUARE, OTHER = Modulation(70.0), Modulation(50.0)
FIELDS = ("x", "z", "intensity", "sigma", "column")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return recorded_scan.source(tmp_path_factory.mktemp("source") / "rec")


def again(folder):
    return reconstruct_recording(load_recording(folder))


def assert_same(points, expected):
    """Equal but for the stage's position by a clock rounded to 1 us, at 50 mm/s."""
    assert len(points) == len(expected) > 500
    for name in FIELDS:
        np.testing.assert_array_equal(points[name], expected[name], err_msg=name)
    np.testing.assert_allclose(points["y"], expected["y"], atol=1e-7, rtol=0)
    assert np.ptp(points["t"] - expected["t"]) < 1e-5


@pytest.mark.parametrize("lost", [(), (40, 41, 46)])
def test_a_recorded_scan_gives_the_same_points(tmp_path, source, lost):
    scan = LiveScan(source, tmp_path / "rec", lost)
    report = scan.run()
    words = scan.recorder.wait(10.0)
    result = again(tmp_path / "rec")
    assert_same(result.points, report.scan.points)
    assert_same(read_cloud(tmp_path / "rec" / "scan.pcd"), report.scan.points)
    assert result.profile_count == report.scan.profiles
    assert report.packets_lost == len(lost)
    for text in (words, " ".join(result.warnings)):
        assert ("3 packets of the recording were lost on the way" in text) == bool(lost)
    assert lost or result.warnings == ()


def test_the_recording_of_a_scan_that_ended_early_has_the_reason_and_its_caller_knows_it(
    tmp_path, source
):
    scan = LiveScan(source, tmp_path / "rec")
    scan.run(reason="canceled")
    assert scan.recorder.wait(10.0) == ""
    assert load_recording(tmp_path / "rec").scan.faults == ["canceled"]


def test_packets_after_the_end_of_the_light_are_not_missed(tmp_path, source):
    """Another modulation ends the recording, which lacks something only where light follows."""
    off, on = (330_000, SQUARE, False), (360_000, OTHER, True)
    for name, after in (("dark", ()), ("lit", (on,))):
        scan = LiveScan(source, tmp_path / name)
        report = scan.run(later=(off, (340_000, OTHER, False), *after))
        words = scan.recorder.wait(DEADLINE_S)
        assert ("packets are not recorded: camera, modulation" in words) == bool(after)
        assert bool(words) == bool(load_recording(tmp_path / name).scan.faults) == bool(after)
        if not after:
            assert_same(again(tmp_path / name).points, report.scan.points)


def test_a_killed_process_leaves_the_recording_up_to_then(tmp_path, source):
    command = [sys.executable, recorded_scan.__file__, source.path, tmp_path / "rec"]
    assert subprocess.run(command, timeout=100).returncode == -9
    result = again(tmp_path / "rec")
    assert any("was not ended" in line for line in result.warnings)
    whole = LiveScan(source, tmp_path / "other").run().scan.points
    # The last period has not come to its end; by a clock of few packets others are at the start.
    known = np.isin(result.points["x"], whole["x"])
    assert known.sum() > 200
    assert np.count_nonzero(~known) < 2 * source.calibration.columns


def test_a_slow_disk_leaves_out_packets_and_holds_up_nothing(tmp_path, source, monkeypatch):
    written, answer = RecordingWriter.events, threading.Event()

    def events(self, data):
        answer.wait(20.0)
        written(self, data)

    monkeypatch.setattr(RecordingWriter, "events", events)
    scan = LiveScan(source, tmp_path / "rec", queue_bytes=50_000)
    began_s = time.monotonic()
    report = scan.run()
    assert time.monotonic() - began_s < 10.0
    assert "still being written" in scan.recorder.wait(0.0)
    answer.set()
    assert "packets are not recorded: the disk" in scan.recorder.wait(10.0)
    whole = LiveScan(source, tmp_path / "other").run().scan.points
    np.testing.assert_array_equal(report.scan.points, whole)
    result = again(tmp_path / "rec")
    assert any("packets are not recorded: the disk" in line for line in result.warnings)
    assert load_recording(tmp_path / "rec").scan.packets_left_out > 10


def test_a_full_disk_ends_the_recording_and_not_the_scan(tmp_path, source):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    scan = LiveScan(source, tmp_path / "rec")
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        report = scan.run()
        words = scan.recorder.wait(10.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "packets are not recorded" in words
    assert "File too large" in words
    whole = LiveScan(source, tmp_path / "other").run().scan.points
    np.testing.assert_array_equal(report.scan.points, whole)
    result = again(tmp_path / "rec")
    assert any("File too large" in line for line in result.warnings)
    known = result.points[: -source.calibration.columns]
    assert len(known) > 50
    np.testing.assert_array_equal(known["x"], whole["x"][: len(known)])


def test_a_folder_that_cannot_be_made_leaves_no_thread(tmp_path, source):
    (tmp_path / "file").write_text("")
    log = ScanLog(scan_id="s", start_mm=0.0, stop_mm=1.0)
    recorder = ScanRecorder(tmp_path / "file" / "rec", log, source.calibration, {})
    fault = recorder.made(5.0)
    assert "cannot" in fault
    assert "being written" not in recorder.wait(0.0)


def test_a_folder_that_comes_too_late_is_removed_and_leaves_no_thread(
    tmp_path, source, monkeypatch
):
    answers = threading.Event()

    def slow(folder):
        assert answers.wait(DEADLINE_S)
        make_recording_folder(folder)

    monkeypatch.setattr(scan_recorder, "make_recording_folder", slow)
    log = ScanLog(scan_id="s", start_mm=0.0, stop_mm=1.0)
    recorder = ScanRecorder(tmp_path / "rec", log, source.calibration, {})
    assert "the disk does not answer" in recorder.made(0.01)
    answers.set()
    assert "being written" not in recorder.wait(DEADLINE_S)
    assert not (tmp_path / "rec").exists()


def test_an_unexpected_error_ends_the_recording_and_not_the_scan(tmp_path, source, monkeypatch):
    def fails(self, data):
        raise MemoryError("no memory")

    monkeypatch.setattr(RecordingWriter, "events", fails)
    scan = LiveScan(source, tmp_path / "rec")
    report = scan.run()
    assert len(report.scan.points) > 500
    assert "no memory" in scan.recorder.wait(10.0)


def test_two_marks_of_one_place_count_both(source):
    marks = np.zeros(2, MARK_DTYPE)
    marks["byte"], marks["packets_lost"], marks["laser_on"] = 3000, [2, 1], [1, 0]
    packets = list(timed_packets(RawReader(source.events_path), marks))
    assert sum(packet.packets_lost for packet in packets) == 3
    assert sum(packet.laser_on for packet in packets) == 1


def test_a_scan_whose_points_are_lost_names_the_loss(source, tmp_path):
    settings = replace(recorded_scan.SETTINGS, events_min=1000)
    report = LiveScan(source, tmp_path / "rec", settings=settings).run()
    assert not report.warnings
    assert "columns have fewer events than events_min = 1000; lower it" in report.message
