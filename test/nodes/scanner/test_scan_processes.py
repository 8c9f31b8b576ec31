"""Scans over real DDS, each node a process of its own."""

import math
import re
import signal
import time
from pathlib import Path

import pytest
import scan_scenarios as scenarios
from action_msgs.msg import GoalStatus
from benches import remote_bench
from eschorty_ros.action import Scan
from eschorty_ros.msg import LaserState
from output_log import read_output_log
from ros_process import NodeProcess, node_name, processes
from waiting import wait_until

from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.core.storage import load_recording
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


def started(module, instrument):
    """A new process of a node in the place of an ended one, once that is forgotten."""
    bench, _, parameters = instrument
    name = node_name(module)
    wait_until(lambda: name not in bench.observer.node.get_node_names(), f"the end of {name}")
    return NodeProcess(module, parameters[module], domain=bench.domain)


@pytest.fixture
def bench(instrument):
    return instrument[0]


@pytest.fixture
def restarted(instrument):
    """Start the reconstruction and the scanner again where a test has failed after their end."""
    yield
    for module in (RECONSTRUCTION, SCANNER):
        processes, name = instrument[1], node_name(module)
        if not processes[name].running():
            processes[name].kill()
            processes[name] = started(module, instrument)


def test_full_scan(bench):
    scenarios.full_scan(bench)


def test_a_scan_waits_for_a_stage_that_has_been_deactivated(bench):
    assert bench.observer.change_state("stage", "deactivate")
    bench.start()
    bench.scans.wait_for(lambda f: "stage: its node is not active" in f.waits_for, "the reason")
    assert bench.observer.change_state("stage", "activate")
    status, result = bench.scans.end()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message


def test_a_canceled_scan_keeps_the_points_so_far(bench):
    """Cancel in the middle: light off, stage stopped, what there is published."""
    before = len(bench.clouds)
    handle = bench.start(**scenarios.SLOW)
    bench.wait_for_sweep()
    canceled = handle.cancel_goal_async()
    wait_until(canceled.done, "an answer to the cancel request")
    status, result = bench.scans.end()
    assert status == GoalStatus.STATUS_CANCELED, result.message
    assert not result.success
    bench.assert_off_and_at_rest()
    assert bench.odometry[-1].pose.pose.position.y < scenarios.FAR_M - 0.005
    scenarios.assert_partial(bench, before, result, to_the_end=True)


def test_bad_goals_are_refused(bench):
    """Each bad value is refused, its name and the remedy in the message; no light."""
    cases = (
        ({"start": -0.01}, ("start", "-0.01", "travel")),
        ({"stop": 0.5}, ("stop", "0.5", "travel")),
        ({"stop": scenarios.START_M}, ("start and stop",)),
        ({"speed": 0.0}, ("speed", "m/s")),
        ({"speed": 9.0}, ("speed", "9")),
        ({"frequency": 5.0}, ("frequency", "5 Hz", "16")),
        ({"frequency": 1e6}, ("frequency", "20000")),
        ({"duty": 1.5}, ("duty", "1.5")),
        ({"start": math.nan}, ("start", "nan")),
    )
    scenarios.assert_refused(bench, bench.scan, cases)


def test_bad_parameters_are_refused(bench):
    """A bad value is refused with a reason, and the old one stays."""
    for node, name, value, word in (
        ("reconstruction", "centroid", "magic", "mode_mean"),
        ("reconstruction", "events_min", 0, "range"),
        ("reconstruction", "line_width_px", -1.0, "range"),
        ("reconstruction", "stage_gap", "soon", "type"),
        ("reconstruction", "frequency", 5.0, "16"),
        ("reconstruction", "calibration", "config_1", "read"),
        ("scanner", "approach_speed", 1.0, "read"),
        ("laser", "frequency", 1.0, "range"),
    ):
        accepted, reason = bench.observer.set_parameter(node, name, value)
        assert not accepted, (node, name)
        assert word in reason.lower(), (node, name, reason)
    for value in (5, 4):
        accepted, reason = bench.observer.set_parameter("reconstruction", "events_min", value)
        assert accepted, reason


def test_a_burst_of_goals_leaves_nothing_behind(bench):
    """Many bad goals at once, around a good one: none is left behind.

    The scan after one that is canceled waits for its end.
    """
    bad = Scan.Goal(start=scenarios.START_M, stop=math.nan, speed=scenarios.SPEED_M_S)
    sent = [bench.scans.client.send_goal_async(bad) for _ in range(150)]
    handle = bench.start(**scenarios.SLOW)
    sent += [bench.scans.client.send_goal_async(bad) for _ in range(150)]
    bench.wait_for_sweep()
    wait_until(handle.cancel_goal_async().done, "an answer to the cancel request")
    canceled = handle.get_result_async()
    scenarios.full_scan(bench)
    wait_until(canceled.done, "the canceled goal's end")
    assert canceled.result().status == GoalStatus.STATUS_CANCELED


@pytest.mark.usefixtures("restarted")
def test_killed_reconstruction_ends_the_scan_at_once(instrument, tmp_path):
    """The reconstruction dies mid-scan: light off at once, reason and recording are named."""
    bench, running, _ = instrument
    assert bench.observer.set_parameter("reconstruction", "record", str(tmp_path))[0]
    process = running["reconstruction"]
    bench.start(**scenarios.SLOW)
    bench.wait_for_sweep()
    process.send(signal.SIGKILL)
    killed_ns = time.monotonic_ns()
    status, result = bench.scans.end()
    ended_s = (time.monotonic_ns() - killed_ns) * 1e-9
    bench.assert_off_and_at_rest()
    dark_s = (read_output_log(bench.laser_log)[-1][0] - killed_ns) * 1e-9
    print(f"dark {dark_s:.3f} s, goal ended {ended_s:.1f} s after the reconstruction")
    assert status == GoalStatus.STATUS_ABORTED
    assert re.search(r"reconstruction: process \d+ is (gone|dead)", result.message), result.message
    assert f"`eschorty reconstruct {result.recording}`" in result.message
    kept = reconstruct_recording(load_recording(result.recording))
    assert len(kept.points) > scenarios.KEPT_POINTS, kept.warnings
    assert dark_s <= 0.25
    process.kill()
    running["reconstruction"] = started(RECONSTRUCTION, instrument)
    scenarios.full_scan(bench)


@pytest.mark.usefixtures("restarted")
def test_killed_scanner_leaves_the_points_so_far(instrument):
    """The scanner dies mid-scan: the reconstruction publishes the points so far."""
    bench, running, _ = instrument
    before = len(bench.clouds)
    # Near, as the stage goes on to its target, in the dark.
    bench.start(**{**scenarios.SLOW, "stop": 0.5 * scenarios.FAR_M})
    bench.wait_for_sweep()
    running["scanner"].send(signal.SIGKILL)
    wait_until(lambda: len(bench.clouds) > before, "the cloud so far")
    assert bench.clouds[-1].width > scenarios.KEPT_POINTS
    wait_until(lambda: bench.output_lines()[-1] == "OFF", "OFF in the emulator's log")
    wait_until(lambda: bench.laser[-1].output == LaserState.OUTPUT_OFF, "the state off")
    running["scanner"].kill()
    running["scanner"] = started(SCANNER, instrument)


@pytest.mark.usefixtures("restarted")
def test_scanner_interrupted_mid_scan_leaves_the_laser_off_and_the_next_one_scans(instrument):
    """The scanner ends mid-scan: without its heartbeat the laser switches off."""
    bench, running, _ = instrument
    first = running["scanner"]
    bench.start(**scenarios.SLOW)
    bench.wait_for_sweep()
    # A renewal that comes late pauses the light.
    wait_until(lambda: bench.output_lines()[-1] == "ON", "the light")
    first.send(signal.SIGINT)
    wait_until(lambda: bench.output_lines()[-1] == "OFF", "OFF in the emulator's log")
    assert first.wait() == 0, first.output
    assert "Traceback" not in first.output, first.output
    first.kill()
    running["scanner"] = started(SCANNER, instrument)
    scenarios.full_scan(bench)


def test_killed_camera_ends_the_scan(instrument, tmp_path):
    bench, running, _ = instrument
    assert bench.observer.set_parameter("reconstruction", "record", str(tmp_path))[0]
    result = scenarios.camera_killed(bench, lambda: running["camera"].send(signal.SIGKILL))
    faults = load_recording(result.recording).scan.faults
    assert any(re.search("the scan ended early: .*camera", fault) for fault in faults), faults
    assert all(process.running() for name, process in running.items() if name != "camera")
