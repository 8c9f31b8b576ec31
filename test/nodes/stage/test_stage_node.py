"""The stage node as a process at an emulated bench: odometry, moves and their refusals."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from benches import bench_here
from diagnostic_msgs.msg import DiagnosticArray
from eschorty_ros.action import MoveStage
from eschorty_ros.msg import PositionTrigger, StageLimits
from nav_msgs.msg import Odometry
from rclpy.action.server import ServerGoalHandle
from rclpy.lifecycle import TransitionCallbackReturn
from ros_process import NodeProcess, Observer, nodes_here, ros_minus_steady_ns, wait_until

from eschorty_ros.emulation.bench.devices import Bench
from eschorty_ros.hardware.stage.apt_stage import AptStage
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.stage.node import StageNode

# To the far end it takes longer than any wait of these tests.
SLOW_M_S = 0.01


class Client:
    """A client of ``stage/move``."""

    def __init__(self, observer: Observer) -> None:
        self._client = observer.action_client(MoveStage, "stage/move")
        wait_until(self._client.server_is_ready, "stage/move")

    def close(self) -> None:
        self._client.destroy()

    def start(self, position: float, speed: float) -> Any:
        """Goal handle of a move, m and m/s."""
        future = self._client.send_goal_async(MoveStage.Goal(position=position, speed=speed))
        wait_until(future.done, "the goal's acceptance")
        handle = future.result()
        assert handle.accepted
        return handle

    @staticmethod
    def finish(handle: Any) -> Any:
        """Status and result of a goal."""
        future = handle.get_result_async()
        wait_until(future.done, "the move's end")
        return future.result()

    def move(self, position: float, speed: float) -> Any:
        return self.finish(self.start(position, speed))


class Stage(Client):
    """A stage node and a client of it, which ``stack`` ends."""

    def __init__(
        self, stack: contextlib.ExitStack, observer: Observer, emulated: Bench, folder: Path
    ) -> None:
        self.emulated = emulated
        self.process = stack.enter_context(
            NodeProcess("eschorty_ros.nodes.stage.node", {"bench": folder}, domain=observer.domain)
        )
        self.odometry = observer.collect(Odometry, "stage/odom", qos.stream(2000))
        self.observer = observer
        observer.wait_for_state("stage", "active")
        super().__init__(observer)
        stack.callback(self.close)
        wait_until(lambda: self.odometry, "odometry")


@pytest.fixture(scope="module")
def started() -> Iterator[Stage]:
    with (
        bench_here() as (emulated, folder),
        Observer() as observer,
        contextlib.ExitStack() as stack,
    ):
        yield Stage(stack, observer, emulated, folder)


@pytest.fixture
def stage(started: Stage) -> Stage:
    """The active node; one that a stall of this computer has failed is configured again."""
    assert started.process.running()
    observer = started.observer
    if observer.lifecycle_state("stage") != "active":
        assert "stage lost: the stage controller sent no status" in started.process.output
        observer.wait_for_state("stage", "unconfigured")
        assert observer.change_state("stage", "configure")
        assert observer.change_state("stage", "activate")
    return started


def test_activate_homes(stage: Stage) -> None:
    wait_until(lambda: stage.odometry[-1].pose.pose.position.y == 0.0, "the home position")


def test_late_subscribers_receive_the_trigger(stage: Stage) -> None:
    received = stage.observer.collect(PositionTrigger, "stage/trigger", qos.latched())
    wait_until(lambda: received, "the position trigger")
    assert received[0].interval == pytest.approx(0.002)
    assert received[0].count > 100


def test_late_subscribers_receive_what_the_controller_reports_within_the_caps(stage: Stage) -> None:
    received = stage.observer.collect(StageLimits, "stage/limits", qos.latched())
    wait_until(lambda: received, "the limits")
    limits = received[0]
    assert (limits.travel_low, limits.travel_high) == (0.0, 0.22)
    assert (limits.speed_max, limits.acceleration) == pytest.approx((0.25, 2.0), rel=1e-3)


def test_move_arrives(stage: Stage) -> None:
    outcome = stage.move(0.02, 0.1)
    assert outcome.status == GoalStatus.STATUS_SUCCEEDED
    assert outcome.result.success
    assert outcome.result.position == pytest.approx(0.02, abs=1e-9)


def test_odometry_lies_on_the_true_motion(stage: Stage) -> None:
    begun = len(stage.odometry)
    stage.move(0.05, 0.1)
    stage.move(0.03, 0.2)
    seen = stage.odometry[begun:]
    assert len(seen) > 20
    stamps_ns = [ns_from_stamp(message.header.stamp) for message in seen]
    # A loaded machine leaves single ones out.
    assert np.median(np.diff(stamps_ns)) < 25_000_000
    offset_ns = ros_minus_steady_ns()
    axis = stage.emulated.stage.axis
    errors_mm = [
        message.pose.pose.position.y * 1e3 - axis.position_mm(stamp_ns - offset_ns)
        for message, stamp_ns in zip(seen, stamps_ns, strict=True)
    ]
    moving = [message.twist.twist.linear.y != 0.0 for message in seen]
    off_mm = np.abs(errors_mm)[moving]
    print(
        f"odometry off by {np.median(off_mm):.4f}, up to {off_mm.max():.4f} mm, {len(off_mm)} times"
    )
    # On a loaded machine single ones lie farther off; delays are tested in virtual time.
    assert np.median(off_mm) < 0.1
    assert {message.pose.covariance[7] > 0.0 for message in seen} == {True}


@pytest.mark.parametrize(
    ("position", "speed", "reason"),
    [(0.5, 0.1, "outside the travel"), (-0.01, 0.1, "outside the travel"), (0.1, 1.0, "speed")],
)
def test_an_impossible_goal_is_aborted_with_a_reason(
    stage: Stage, position: float, speed: float, reason: str
) -> None:
    outcome = stage.move(position, speed)
    assert outcome.status == GoalStatus.STATUS_ABORTED
    assert reason in outcome.result.message


def test_second_move_is_refused_and_cancel_stops(stage: Stage) -> None:
    start_m = stage.odometry[-1].pose.pose.position.y
    handle = stage.start(0.2, SLOW_M_S)
    wait_until(lambda: stage.odometry[-1].twist.twist.linear.y > 0.99 * SLOW_M_S, "full speed")
    assert "another move" in stage.move(0.0, 0.1).result.message
    cancelled = handle.cancel_goal_async()
    wait_until(cancelled.done, "the cancel's answer")
    outcome = stage.finish(handle)
    assert outcome.status == GoalStatus.STATUS_CANCELED
    assert start_m < outcome.result.position < 0.2
    wait_until(lambda: stage.odometry[-1].twist.twist.linear.y == 0.0, "rest")
    assert stage.move(0.03, 0.25).result.success


def test_deactivate_stops_a_move(stage: Stage) -> None:
    handle = stage.start(0.2, SLOW_M_S)
    wait_until(lambda: stage.odometry[-1].twist.twist.linear.y > 0.0, "motion")
    assert stage.observer.change_state("stage", "deactivate")
    outcome = stage.finish(handle)
    assert outcome.status == GoalStatus.STATUS_ABORTED
    assert "stopped at" in outcome.result.message
    assert "inactive" in stage.move(0.1, 0.1).result.message
    assert stage.observer.change_state("stage", "activate")


def test_deactivate_just_before_a_move_begins_stops_it(
    observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    move_to = AptStage.move_to
    with bench_here() as (_, folder), nodes_here(observer.domain, 4) as start:
        node = start(StageNode, bench=str(folder))

        def deactivated(stage: AptStage, position_mm: float, speed_mm_s: float) -> None:
            assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
            move_to(stage, position_mm, speed_mm_s)

        monkeypatch.setattr(AptStage, "move_to", deactivated)
        wait_until(lambda: node.active, "the node active")
        with contextlib.closing(Client(observer)) as client:
            outcome = client.move(0.2, SLOW_M_S)
    assert outcome.status == GoalStatus.STATUS_ABORTED
    assert "stopped at" in outcome.result.message
    assert outcome.result.position < 0.01


def test_a_move_that_cannot_be_followed_is_stopped(
    observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def publish_feedback(*_: Any) -> None:
        raise RuntimeError("no buffer")

    monkeypatch.setattr(ServerGoalHandle, "publish_feedback", publish_feedback)
    with bench_here() as (emulated, folder), nodes_here(observer.domain, 4) as start:
        node = start(StageNode, bench=str(folder))
        wait_until(lambda: node.active, "the node active")
        with contextlib.closing(Client(observer)) as client:
            assert client.move(0.2, SLOW_M_S).status == GoalStatus.STATUS_ABORTED
        axis = emulated.stage.axis
        wait_until(lambda: not axis.moving(time.monotonic_ns()), "rest")
        assert axis.position_mm(time.monotonic_ns()) < 10.0


def test_a_refused_command_is_one_warning(stage: Stage) -> None:
    reports = stage.observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
    stage.emulated.stage.extra_bits = 0x8000

    def messages() -> list[str]:
        statuses = [status for report in list(reports) for status in report.status]
        return [status.message for status in statuses if "stage" in status.name]

    refused = "the stage controller refused a command"
    wait_until(lambda: refused in messages(), "the warning")
    wait_until(lambda: len(messages()) >= messages().index(refused) + 3, "later diagnostics")
    assert messages().count(refused) == 1
    stage.emulated.stage.extra_bits = 0


def test_interrupt_in_a_move_exits_clean_and_the_result_names_it(stage: Stage) -> None:
    result = stage.start(0.0, 0.01).get_result_async()
    assert stage.process.interrupt() == 0
    assert "Traceback" not in stage.process.output
    wait_until(result.done, "the move's end")
    assert result.result().result.message == "move interrupted by shutdown"
