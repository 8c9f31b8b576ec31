"""The stage node on its real driver, a pseudo-terminal between it and the emulated controller."""

from __future__ import annotations

import contextlib
import itertools
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from eschorty_ros.action import MoveStage
from eschorty_ros.msg import PositionTrigger
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient
from ros_process import NodeProcess, Observer, wait_until

from eschorty_ros.emulation.apt.model import AptModel
from eschorty_ros.emulation.bus import PtyPort
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.conversions import ns_from_stamp
from eschorty_ros.nodes.ros.domain import free_domain

SETTINGS = {"driver": "apt", "homing_speed": 0.1, "trigger_interval": 0.005}


@pytest.fixture
def model() -> AptModel:
    return AptModel(time.time_ns, power_up_mm=2.0)


@pytest.fixture
def port(model: AptModel, tmp_path: Path) -> Iterator[str]:
    with PtyPort(model, tmp_path / "stage"):
        yield str(tmp_path / "stage")


@pytest.fixture
def observer() -> Iterator[Observer]:
    with Observer(free_domain(), "stage_observer") as observer:
        yield observer


def test_moves_with_odometry_on_the_true_motion(
    port: str, model: AptModel, observer: Observer
) -> None:
    with (
        NodeProcess(
            "eschorty_ros.nodes.stage.node", {**SETTINGS, "port": port}, domain=observer.domain
        ) as process,
        contextlib.ExitStack() as held,
    ):
        odometry = observer.collect(Odometry, "stage/odom", qos.stream(2000))
        triggers = observer.collect(PositionTrigger, "stage/trigger", qos.latched())
        client = ActionClient(observer.node, MoveStage, "stage/move")
        held.callback(client.destroy)
        observer.wait_for_state("stage", "active")
        wait_until(client.server_is_ready, "stage/move")
        wait_until(lambda: triggers, "the trigger")
        assert (triggers[0].first, triggers[0].interval, triggers[0].count) == (0.005, 0.005, 43)
        for position in (0.01, 0.21):
            begun = len(odometry)
            sent = client.send_goal_async(MoveStage.Goal(position=position, speed=0.2))
            wait_until(sent.done, "acceptance")
            ended = sent.result().get_result_async()
            wait_until(ended.done, "the end")
            assert ended.result().status == GoalStatus.STATUS_SUCCEEDED
        seen = odometry[begun:]
        stamps = [ns_from_stamp(message.header.stamp) for message in seen]
        assert max(b - a for a, b in itertools.pairwise(stamps)) < 25_000_000
        errors = [
            abs(message.pose.pose.position.y * 1e3 - model.axis.position_mm(stamp))
            for message, stamp in zip(seen, stamps, strict=True)
            if message.twist.twist.linear.y != 0.0
        ]
        off_mm = statistics.median(errors)
        print(f"odometry of a real process: {off_mm:.3f}, up to {max(errors):.3f} mm at 200 mm/s")
        # Single ones lie farther off where a loaded machine lets the controller answer late.
        assert off_mm < 0.1
        assert process.interrupt() == 0
        assert "Traceback" not in process.output


@pytest.mark.fault("serial unplugged, silent")
def test_an_unplugged_stage_makes_the_node_leave_active(
    port: str, model: AptModel, observer: Observer
) -> None:
    """driver: the node leaves the active state; user reads: stage lost: the stage's port failed."""
    with NodeProcess(
        "eschorty_ros.nodes.stage.node", {**SETTINGS, "port": port}, domain=observer.domain
    ) as process:
        reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
        observer.wait_for_state("stage", "active")
        model.gone = True
        wait_until(lambda: "stage lost: the stage's port failed" in process.output, "the log")
        wait_until(
            lambda: any("port failed" in s.message for m in reports for s in m.status),
            "diagnostics",
        )
        assert process.interrupt() == 0
        assert "Traceback" not in process.output


@pytest.mark.fault("shutdown at any time")
def test_an_interrupt_while_homing_stops_the_carriage(tmp_path: Path, observer: Observer) -> None:
    """driver: stops the carriage, closes the port, within 2 s; user reads: nothing; exit code 0."""
    model = AptModel(time.time_ns, power_up_mm=150.0)
    with (
        PtyPort(model, tmp_path / "stage"),
        NodeProcess(
            "eschorty_ros.nodes.stage.node",
            {**SETTINGS, "homing_speed": 0.01, "port": str(tmp_path / "stage")},
            domain=observer.domain,
        ) as process,
    ):
        wait_until(lambda: model.axis.moving(time.time_ns()), "homing")
        assert process.interrupt() == 0
        assert "Traceback" not in process.output
        # The last bytes of the process may still be on the line.
        wait_until(lambda: not model.axis.moving(time.time_ns()), "rest")
        assert 1.0 < model.axis.position_mm(time.time_ns()) < 150.0
