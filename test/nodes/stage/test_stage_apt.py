"""The stage node on its real driver, a pseudo-terminal between it and the emulated controller."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros_process import NodeProcess, Observer, wait_until
from std_msgs.msg import Empty

from eschorty_ros.emulation.apt.model import AptModel
from eschorty_ros.emulation.bus import PtyPort
from eschorty_ros.nodes.ros import qos


@contextlib.contextmanager
def running(
    tmp_path: Path,
    observer: Observer,
    power_up_mm: float,
    homing_speed: float,
    module: str = "eschorty_ros.nodes.stage.node",
) -> Iterator[tuple[AptModel, NodeProcess]]:
    """The emulated controller and the node, which ends well."""
    model, port = AptModel(time.time_ns, power_up_mm=power_up_mm), tmp_path / "stage"
    settings = {"driver": "apt", "homing_speed": homing_speed, "port": port}
    with (
        PtyPort(model, port),
        NodeProcess(module, settings, domain=observer.domain) as process,
    ):
        yield model, process
        assert process.interrupt() == 0
        assert "Traceback" not in process.output


@pytest.mark.fault("serial line unplugged, no answer")
def test_an_unplugged_stage_makes_the_node_leave_active(tmp_path: Path, observer: Observer) -> None:
    """driver: the node leaves the active state; user reads: stage lost: the stage's port failed."""
    with running(tmp_path, observer, 2.0, 0.1) as (model, process):
        reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
        observer.wait_for_state("stage", "active")
        model.gone = True
        wait_until(lambda: "stage lost: the stage's port failed" in process.output, "the log")

        def reported() -> bool:
            every = [status for message in list(reports) for status in message.status]
            return any(
                s.level == DiagnosticStatus.ERROR and "port failed" in s.message for s in every
            )

        wait_until(reported, "diagnostics")
        observer.wait_for_state("stage", "unconfigured")
        model.gone = False
        wait_until(lambda: observer.change_state("stage", "configure"), "the port open again")
        assert observer.change_state("stage", "activate")


def test_an_odometry_that_fails_makes_the_node_leave_active(
    tmp_path: Path, observer: Observer
) -> None:
    with running(tmp_path, observer, 2.0, 0.1, "breakable_stage") as (_, process):
        observer.wait_for_state("stage", "active")
        observer.publisher(Empty, "test/break", 10).publish(Empty())
        wait_until(lambda: "odometry failed: ValueError('no number')" in process.output, "the log")
        observer.wait_for_state("stage", "unconfigured")


@pytest.mark.fault("shutdown at any time")
def test_an_interrupt_while_homing_stops_the_carriage(tmp_path: Path, observer: Observer) -> None:
    """driver: stops the carriage, closes the port, within 2 s; user reads: nothing; exit code 0."""
    with running(tmp_path, observer, 150.0, 0.01) as (model, process):
        wait_until(lambda: model.axis.moving(time.time_ns()), "homing")
        assert process.interrupt() == 0
        # The last bytes of the process may still be on the line.
        wait_until(lambda: not model.axis.moving(time.time_ns()), "rest")
        assert 1.0 < model.axis.position_mm(time.time_ns()) < 150.0
