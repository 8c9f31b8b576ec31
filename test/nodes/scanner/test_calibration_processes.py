"""Calibrations over real DDS, each node a process of its own."""

import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import calibration_scenarios as scenarios
from benches import remote_bench
from ros_process import NodeProcess, processes

from eschorty_ros.nodes.ros.domain import free_domain

CAMERA = "eschorty_ros.nodes.camera.node"


class Instrument:
    """The test's view, the running nodes, and a camera that can be pointed elsewhere."""

    def __init__(self, bench, running, emulated, bench_folder):
        self.bench, self.running = bench, running
        self._emulated = emulated
        self._camera = scenarios.device_parameters(bench_folder)[CAMERA]

    def point_camera_at(self, scene):
        self.running["camera"].interrupt()
        self.running["camera"].kill()
        self._emulated.do(scene)
        self.running["camera"] = NodeProcess(CAMERA, self._camera, domain=self.bench.domain)
        self.bench.observer.wait_for_state("camera", "active")


@pytest.fixture(scope="module")
def instrument(tmp_path_factory):
    """Five node processes at a bench; the reconstruction's end comes last."""
    log = Path(tmp_path_factory.mktemp("laser")) / "output.log"
    folder = Path(tmp_path_factory.mktemp("calibrations")) / "made"
    domain = free_domain()
    settings = scenarios.bench_settings(log, scenarios.KNOWN_SCENE)
    with (
        remote_bench(**settings) as (emulated, bench_folder),
        processes(scenarios.node_parameters(bench_folder, folder), domain) as running,
        scenarios.bench(domain, log, folder) as bench,
    ):
        yield Instrument(bench, running, emulated, bench_folder)
        for name, process in running.items():
            print(f"--- {name}\n{process.output[-3000:]}")


def test_an_uncalibrated_scan_is_off_by_tens_of_mm(instrument):
    scenarios.uncalibrated_scan_is_off(instrument.bench)


def test_useless_captures_change_nothing(instrument):
    instrument.point_camera_at("posts")
    scenarios.useless_captures(instrument.bench)


def test_one_thing_at_a_time(instrument):
    scenarios.one_thing_at_a_time(instrument.bench)


def test_nine_posts_calibrate_the_same_scan_to_one_mm(instrument):
    # The command's test takes the other method through the same nodes.
    scenarios.nine_posts(instrument.bench, "paper")
    instrument.point_camera_at(scenarios.KNOWN_SCENE)
    scenarios.calibrated_scan_is_right(instrument.bench)


def test_only_calibrations_of_this_instrument_are_loaded(instrument):
    scenarios.load_and_save(instrument.bench)


def test_bad_goals_are_refused(instrument):
    scenarios.bad_goals(instrument.bench)


def test_killed_camera_ends_the_calibration(instrument):
    camera = instrument.running["camera"]
    scenarios.camera_killed(instrument.bench, lambda: camera.send(signal.SIGKILL))


def test_a_target_moved_by_the_stage_calibrates_too(instrument):
    instrument.point_camera_at("receding")
    scenarios.moving_target(instrument.bench)


def test_interrupted_reconstruction_leaves_the_laser_off(instrument):
    process = instrument.running["reconstruction"]
    scenarios.reconstruction_interrupted(instrument.bench, lambda: process.send(signal.SIGINT))
    assert process.wait() == 0, process.output
    assert "Traceback" not in process.output, process.output
