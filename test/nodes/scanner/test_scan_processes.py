"""Scans over real DDS, each node a process of its own."""

import signal
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import scan_scenarios as scenarios
from benches import remote_bench
from ros_process import NodeProcess, node_name, processes
from waiting import wait_until

from eschorty_ros.nodes.ros.domain import free_domain

SCANNER = "eschorty_ros.nodes.scanner.node"
RECONSTRUCTION = "eschorty_ros.nodes.reconstruction.node"


@pytest.fixture(scope="module")
def instrument(tmp_path_factory):
    """Five node processes at a bench; the camera's death comes last."""
    log = Path(tmp_path_factory.mktemp("laser")) / "output.log"
    domain = free_domain()
    with (
        remote_bench(**scenarios.bench_settings(log)) as (_, folder),
        processes(scenarios.node_parameters(folder), domain) as running,
        scenarios.bench(domain, log) as bench,
    ):
        yield bench, running, scenarios.node_parameters(folder)
        for name, process in running.items():
            print(f"--- {name}\n{process.output[-3000:]}")


def started(module, instrument):
    """A new process of a node in the place of an ended one, once that is forgotten."""
    bench, _, parameters = instrument
    name = node_name(module)
    wait_until(lambda: name not in bench.observer.node.get_node_names(), f"the end of {name}")
    return NodeProcess(module, parameters[module], domain=bench.domain)


def test_full_scan(instrument):
    scenarios.full_scan(instrument[0])


def test_cancel(instrument):
    scenarios.cancel_scan(instrument[0])


def test_bad_goals_are_refused(instrument):
    scenarios.bad_goals(instrument[0])


def test_bad_parameters_are_refused(instrument):
    scenarios.bad_parameters(instrument[0])


def test_a_burst_of_goals_leaves_nothing_behind(instrument):
    scenarios.burst_of_goals(instrument[0], 150)
    scenarios.full_scan(instrument[0])


def test_killed_reconstruction_ends_the_scan_at_once(instrument):
    bench, running, _ = instrument
    process = running["reconstruction"]
    scenarios.reconstruction_killed(bench, lambda: process.send(signal.SIGKILL))
    process.kill()
    running["reconstruction"] = started(RECONSTRUCTION, instrument)


def test_killed_scanner_leaves_the_points_so_far(instrument):
    bench, running, _ = instrument
    scenarios.scanner_killed(bench, lambda: running["scanner"].send(signal.SIGKILL))
    running["scanner"].kill()
    running["scanner"] = started(SCANNER, instrument)


def test_scanner_interrupted_mid_scan_leaves_the_laser_off_and_the_next_one_scans(instrument):
    bench, running, _ = instrument
    first = running["scanner"]
    scenarios.scanner_interrupted(bench, lambda: first.send(signal.SIGINT))
    assert first.wait() == 0, first.output
    assert "Traceback" not in first.output, first.output
    first.kill()
    running["scanner"] = started(SCANNER, instrument)
    scenarios.full_scan(bench)


def test_killed_camera_ends_the_scan(instrument):
    bench, running, _ = instrument
    scenarios.camera_killed(bench, lambda: running["camera"].send(signal.SIGKILL))
    assert all(process.running() for name, process in running.items() if name != "camera")
