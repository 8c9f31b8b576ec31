"""Scans over real DDS, each node a process of its own."""

import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import scan_scenarios as scenarios
from ros_process import free_domain, processes


@pytest.fixture(scope="module")
def instrument(tmp_path_factory):
    """Five node processes and a bench; the camera's death comes last."""
    log = Path(tmp_path_factory.mktemp("laser")) / "output.log"
    domain = free_domain()
    with (
        processes(scenarios.node_parameters(log), domain) as running,
        scenarios.bench(domain, log) as bench,
    ):
        yield bench, running
        for name, process in running.items():
            print(f"--- {name}\n{process.output[-3000:]}")


def test_full_scan(instrument):
    scenarios.full_scan(instrument[0])


def test_cancel(instrument):
    scenarios.cancel_scan(instrument[0])


def test_bad_goals_are_refused(instrument):
    scenarios.bad_goals(instrument[0])


def test_bad_parameters_are_refused(instrument):
    scenarios.bad_parameters(instrument[0])


def test_killed_camera_ends_the_scan(instrument):
    bench, running = instrument
    scenarios.camera_killed(bench, lambda: running["camera"].send(signal.SIGKILL))
    assert all(process.running() for name, process in running.items() if name != "camera")
