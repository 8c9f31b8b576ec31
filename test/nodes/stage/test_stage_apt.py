"""The stage node on its real driver, a pseudo-terminal between it and the emulated controller."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from ros_process import NodeProcess, Observer, wait_until

from eschorty_ros.emulation.apt.model import AptModel
from eschorty_ros.emulation.bus import PtyPort
from eschorty_ros.nodes.ros import qos
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


@pytest.mark.fault("serial line unplugged, no answer")
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
