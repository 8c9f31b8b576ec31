"""The viewer's node against a scanner and a laser that come, go and come back; no browser."""

import contextlib
import socket
import threading
import time

import pytest
import rclpy
from click.testing import CliRunner
from eschorty_ros.action import Scan
from eschorty_ros.msg import LaserState, ReconstructionState
from rclpy.action import ActionServer, CancelResponse
from rclpy.node import Node
from rclpy.parameter import Parameter

from eschorty_ros.cli import main
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.border import refusals
from eschorty_ros.nodes.ros.executor import Spinning
from eschorty_ros.nodes.viewer import node as viewer_module
from eschorty_ros.nodes.viewer.node import ViewerNode
from eschorty_ros.viewer.scan_control import ScanValues

VALUES = ScanValues(stop_mm=20.0, duty=0.3, passes=2)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Instrument(Node):
    """Answers as scanner, reconstruction and laser do."""

    def __init__(self, **state):
        super().__init__("reconstruction", namespace="/eschorty")
        self.declare_parameter("record", "/before")
        self.goals, self.recorded = [], []
        self.release, self.stopped = threading.Event(), False
        self._state = LaserState(**state)
        self._publisher = self.create_publisher(LaserState, "laser/state", qos.latched(100))
        self.create_timer(0.1, lambda: self._publisher.publish(self._state))
        self._server = ActionServer(
            self, Scan, "scan", self._execute, cancel_callback=lambda _: CancelResponse.ACCEPT
        )

    def _execute(self, goal):
        self.goals.append(goal.request)
        self.recorded.append(self.get_parameter("record").value)
        while not self.release.wait(0.05) and not goal.is_cancel_requested:
            if not self.stopped:
                goal.publish_feedback(Scan.Feedback(phase="sweeping"))
        if goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.succeed()
        return Scan.Result(verdict="complete", points=7, recording=self.recorded[-1])


@pytest.fixture
def world(monkeypatch):
    """A viewer that may start scans, and a way to add and remove an instrument."""
    monkeypatch.setattr(viewer_module, "_SCANNER_TIMEOUT_S", 1.0)
    rclpy.init()
    spinning = Spinning(6)
    values = [Parameter("allow_scan", value=True), Parameter("port", value=free_port())]
    viewer = ViewerNode(namespace="/eschorty", parameter_overrides=values)
    spinning.executor.add_node(viewer)
    spinning.start()

    @contextlib.contextmanager
    def instrument(**kwargs):
        node = Instrument(**kwargs)
        spinning.executor.add_node(node)
        try:
            yield node
        finally:
            # A goal that waits for it would keep the process for ever.
            node.release.set()
            spinning.executor.remove_node(node)
            node._server.destroy()
            node.destroy_node()

    yield viewer, instrument
    viewer.safe_state()
    spinning.end()
    viewer.destroy_node()
    rclpy.try_shutdown()


def wait(condition, limit_s=30.0):
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s, "timed out"
        time.sleep(0.05)


def ask(viewer, values=VALUES):
    """As a page does: the values and the code."""
    with viewer.page._lock:
        viewer.page._start = values, viewer._control.code


def says(viewer, words):
    return lambda: words in viewer._status.message


def test_a_scan_of_the_page_has_all_its_values_and_outlives_no_scanner(world):
    viewer, instrument = world
    ask(viewer)
    wait(says(viewer, "no scanner is there"))
    with instrument(interlock_open=True):
        wait(lambda: viewer._conditions().laser and viewer._conditions().scanner)
        ask(viewer)
        wait(says(viewer, "interlock is open"))
    wait(lambda: not viewer._conditions().scanner)
    with instrument() as first:
        wait(lambda: not viewer._conditions().refusal())
        ask(viewer, VALUES._replace(record="/data"))
        wait(lambda: first.goals)
        [goal] = first.goals
        assert (goal.stop, goal.duty, goal.passes) == pytest.approx((0.02, 0.3, 2))
        assert first.recorded == ["/data"]
        assert "requested: 10 to 20 mm" in viewer._status.message
        assert "duty 0.3, passes: 2, recorded into /data" in viewer._status.message
        ask(viewer)
        wait(says(viewer, "a scan is running"))
        first.release.set()
        wait(says(viewer, "complete, 7 points; recorded into /data"))
        wait(lambda: first.get_parameter("record").value == "/before")
        first.release.clear()
        ask(viewer)
        wait(lambda: len(first.goals) == 2)
        assert first.recorded[1] == "/before"
        with viewer.page._lock:
            viewer.page._cancel = True
        wait(says(viewer, "complete, 7 points"))
        # Before the scanner has accepted it.
        first.release.clear()
        begun = len(first.goals)
        ask(viewer, VALUES._replace(record="/data"))
        with viewer.page._lock:
            viewer.page._cancel = True
        wait(lambda: not viewer._control.under_way and viewer.page._start is None)
        assert len(first.goals) == begun
        wait(says(viewer, "canceled before it began"))
        wait(lambda: first.get_parameter("record").value == "/before")
        with viewer.page._lock:
            viewer.page._cancel = True
        wait(says(viewer, "no scan of this page is under way"))
        first.stopped = True
        ask(viewer)
        wait(lambda: len(first.goals) == begun + 1)
        wait(says(viewer, "the scanner does not answer"))
        first.release.set()
        time.sleep(0.5)
        assert says(viewer, "the scanner does not answer")(), "a late result"
    wait(lambda: not viewer._conditions().scanner)
    with instrument() as second:
        wait(lambda: not viewer._conditions().refusal())
        ask(viewer)
        wait(lambda: second.goals)
        second.release.set()
        wait(says(viewer, "complete"))


def test_the_page_shows_who_scans_and_why_the_laser_is_off_until_reports_end(world, monkeypatch):
    monkeypatch.setattr(viewer_module, "_REPORT_TIMEOUT_S", 1.0)
    viewer, instrument = world
    reason = f"treat the laser as on {'-' * 400} by hand"

    def shows(*texts):
        return lambda: all(text in viewer._status.markdown(0, 1) for text in texts)

    assert shows("| scan | none |", "| events/s | no report |")()
    with instrument(output=LaserState.OUTPUT_UNKNOWN, reason=reason) as node:
        state = ReconstructionState(scan_id="of another client", events_per_second=5e5, points=7)
        publisher = node.create_publisher(ReconstructionState, "reconstruction/state", 10)
        timer = node.create_timer(0.1, lambda: publisher.publish(state))
        wait(shows("**unknown** treat the laser as on ---", "--- by hand", "of another client"))
        wait(shows("500,000", "| points | 7 |"))
        assert viewer._conditions().scanning
        timer.cancel()
        wait(shows("| scan | none |", "| events/s | no report |"))
        assert "| points |" not in viewer._status.markdown(0, 1)
        assert not viewer._conditions().scanning
    assert not refusals(viewer).counts


def test_a_scan_that_is_to_be_recorded_needs_a_reconstruction(world):
    viewer, instrument = world
    with instrument() as node:
        wait(lambda: not viewer._conditions().refusal())
        for service in list(node.services):
            if "parameters" in service.service_name:
                node.destroy_service(service)
        wait(lambda: not viewer._get_parameters.service_is_ready())
        ask(viewer, VALUES._replace(record="/data"))
        wait(says(viewer, "not started: no reconstruction to record"))
        assert not node.goals


def test_the_command_starts_the_node_as_the_launch_files_do(monkeypatch):
    given = []
    monkeypatch.setattr(viewer_module, "main", given.extend)
    done = CliRunner().invoke(main, ["view", "--live", "--port", str(free_port())])
    assert done.exit_code == 0, done.output
    rclpy.init(args=given)
    try:
        node = Node("viewer")
        assert node.get_fully_qualified_name() == "/eschorty/viewer"
        assert (node.get_name(), "/eschorty", "/eschorty/viewer") in (
            node.get_node_names_and_namespaces_with_enclaves()
        )
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
