"""Diagnostics of the reconstruction node."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from line_events import encoded, line_events

from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.live.job_queue import JobQueue
from eschorty_ros.live.packet_times import Packet
from eschorty_ros.live.pipeline import Pipeline
from eschorty_ros.nodes.reconstruction.reports import Reports
from eschorty_ros.nodes.ros import diagnostics


@pytest.mark.parametrize("lost", [False, True])
def test_a_warning_of_the_reconstruction_is_the_line_of_the_diagnostics(lost):
    rng = np.random.default_rng(3)
    data = encoded(line_events(rng, lambda k, c: np.full(len(c), 300.0), periods=8, edge_us=1000))
    if lost:
        data += np.array([w3.OTHERS << 12 | w3.DROPPED_EVENTS], "<u2").tobytes()
    pipeline = Pipeline(load_calibration("config_3"), Settings(), 1.0, 0.1, 10.0)
    pipeline.stream.announce_zero(0)
    pipeline.stream.set_laser(Modulation(70.0), 1_000_000)
    pipeline.stream.add(Packet(0, 0, data), 0.0)
    assert pipeline.complete(0.0), "seed 3"
    node = SimpleNamespace(create_publisher=lambda *_: None)
    level, line, _ = Reports(node, pipeline, JobQueue(1)).diagnose()
    if lost:
        assert level == diagnostics.WARN
        assert "its readout lost events" in line
    else:
        assert (level, line) == (diagnostics.OK, "reconstructing")


def test_a_loss_is_reported_once_beside_other_warnings():
    pipeline = Pipeline(load_calibration("config_3"), Settings(), 1.0, 0.1, 10.0)
    pipeline.stream.announce_zero(0)
    pipeline.stream.set_laser(Modulation(70.0), 1_000_000)
    rng = np.random.default_rng(3)
    data = encoded(line_events(rng, lambda k, c: np.full(len(c), 300.0), periods=8, edge_us=1000))
    for seq, half in ((0, data[: len(data) // 2 & ~1]), (3, data[len(data) // 2 & ~1 :])):
        pipeline.stream.add(Packet(seq, 0, half), 0.0)
    pipeline.complete(0.0)
    node = SimpleNamespace(create_publisher=lambda *_: None)
    reports = Reports(node, pipeline, JobQueue(1))
    level, line, _ = reports.diagnose()
    assert level == diagnostics.WARN, "seed 3"
    assert "2 packets lost since the last report, 2 so far" in line
    assert "packets lost" not in reports.diagnose()[1]


@pytest.mark.parametrize(
    ("ahead_s", "why"),
    [(None, "nothing has come on stage/odom"), (3600.0, "newest sample of stage/odom is +3599.9")],
)
def test_points_without_stage_are_logged_with_how_far_its_clock_is(ahead_s, why):
    pipeline = Pipeline(load_calibration("config_3"), Settings(), 1.0, 0.1, 10.0)
    pipeline.stream.announce_zero(0)
    pipeline.stream.set_laser(Modulation(70.0), 1_000_000)
    if ahead_s is not None:
        pipeline.add_stage(round(ahead_s * 1e9), 0.0)
    rng = np.random.default_rng(3)
    data = encoded(line_events(rng, lambda k, c: np.full(len(c), 300.0), periods=8, edge_us=1000))
    pipeline.stream.add(Packet(0, 0, data), 0.0)
    pipeline.complete(0.0)
    assert not pipeline.place(11.0), "seed 3"
    logged = []
    logger = SimpleNamespace(warning=lambda line, **_: logged.append(line))
    node = SimpleNamespace(create_publisher=lambda *_: None, get_logger=lambda: logger)
    level, line, _ = Reports(node, pipeline, JobQueue(1)).diagnose()
    assert level == diagnostics.WARN
    assert why in line
    assert "points without stage position" in logged[0]


def test_no_packets_is_a_warning_after_some_seconds(monkeypatch):
    pipeline = Pipeline(load_calibration("config_3"), Settings(), 1.0, 0.1, 10.0)
    logged = []
    logger = SimpleNamespace(warning=lambda line, **_: logged.append(line))
    node = SimpleNamespace(
        create_publisher=lambda *_: None,
        get_logger=lambda: logger,
        resolve_topic_name=lambda _: "/driver/events",
    )
    reports = Reports(node, pipeline, JobQueue(1))
    assert reports.diagnose()[:2] == (diagnostics.OK, "no packets yet")
    assert not logged
    monkeypatch.setattr("eschorty_ros.nodes.reconstruction.reports.PACKETS_EXPECTED_S", 0.0)
    assert reports.diagnose()[:2] == (diagnostics.WARN, "no packets yet")
    assert "no packets on /driver/events yet" in logged[0]


def test_packets_that_no_longer_come_are_a_warning_after_some_seconds(monkeypatch):
    pipeline = Pipeline(load_calibration("config_3"), Settings(), 1.0, 0.1, 10.0)
    pipeline.stream.announce_zero(0)
    pipeline.stream.set_laser(Modulation(70.0), 1_000_000)
    node = SimpleNamespace(create_publisher=lambda *_: None)
    reports = Reports(node, pipeline, JobQueue(1))
    rng = np.random.default_rng(3)
    data = encoded(line_events(rng, lambda k, c: np.full(len(c), 300.0), periods=8, edge_us=1000))
    half = len(data) // 2 & ~1
    pipeline.stream.add(Packet(0, 0, data[:half]), 0.0)
    pipeline.complete(0.0)
    monkeypatch.setattr("eschorty_ros.nodes.reconstruction.reports.PACKETS_EXPECTED_S", 0.01)
    assert reports.diagnose()[:2] == (diagnostics.OK, "reconstructing")
    time.sleep(0.02)
    expected = "no packets for 0 s; check the camera"
    assert reports.diagnose()[:2] == (diagnostics.WARN, expected)
    pipeline.stream.add(Packet(1, 0, data[half:]), 0.0)
    pipeline.complete(0.0)
    assert reports.diagnose()[:2] == (diagnostics.OK, "reconstructing"), "seed 3"


@pytest.mark.parametrize("taken", [False, True])
def test_packets_that_wait_have_a_line_unless_the_worker_takes_them_meanwhile(monkeypatch, taken):
    pipeline = Pipeline(load_calibration("config_3"), Settings(), 1.0, 0.1, 10.0)
    pipeline.stream.add(Packet(0, 0, b""), 0.0)
    if taken:
        monkeypatch.setattr(type(pipeline.stream), "waits_for", "")
    node = SimpleNamespace(create_publisher=lambda *_: None)
    line = Reports(node, pipeline, JobQueue(1)).diagnose()[1]
    assert line == ("no packets yet" if taken else "packets wait for the modulation")
