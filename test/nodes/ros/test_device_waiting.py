"""A node whose device is missing at the start: reason logged once, retried, no traceback."""

import functools
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from ros_process import Observer, nodes_here, wait_until

from eschorty_ros.core.base.errors import ArgumentError, DeviceError
from eschorty_ros.nodes.ros import diagnostics, lifecycle, qos
from eschorty_ros.nodes.ros.lifecycle import DeviceNode


class Device:
    """Answers of the next attempts to open; ``None`` opens."""

    def __init__(self, *answers: Exception | None) -> None:
        self.answers = list(answers)
        self.attempts = 0

    def open(self) -> None:
        self.attempts += 1
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if answer is not None:
            raise answer


class Instrument(DeviceNode):
    """A node around ``Device``."""

    def __init__(self, device: Device, **kwargs: Any) -> None:
        self.device = device
        self.closed = 0
        super().__init__("instrument", (), **kwargs)
        diagnostics.Diagnostics(self, lambda: (diagnostics.OK, self.state_label, {}))

    def open_device(self) -> None:
        self.device.open()

    def start_device(self) -> None: ...

    def stop_device(self) -> None: ...

    def close_device(self) -> None:
        self.closed += 1


@pytest.fixture
def run(observer: Observer, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setattr(lifecycle, "RETRY_S", 0.3)
    with nodes_here(observer.domain) as start:
        yield lambda *answers: start(functools.partial(Instrument, Device(*answers)))


def test_simulated_time_is_refused(observer) -> None:
    with (
        nodes_here(observer.domain) as start,
        pytest.raises(ArgumentError, match=r"use_sim_time is true.* leave it out for instrument"),
    ):
        start(functools.partial(Instrument, Device(None)), use_sim_time=True)


def test_simulated_time_is_refused_later_too(run) -> None:
    node = run(None)
    (answer,) = node.set_parameters([Parameter("use_sim_time", value=True)])
    assert not answer.successful
    assert "leave it out for instrument" in answer.reason
    assert node.get_parameter("use_sim_time").value is False
    assert abs(node.now_ns() - time.time_ns()) < 1e9


def test_an_absent_device_is_retried_and_logged_once_per_reason(run, observer, capfd) -> None:
    reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
    absent, held = DeviceError("no camera found; plug it in"), DeviceError("camera is held")
    node = run(*[absent] * 5, held)
    expected = [f"waiting: {e}; trying again every 0.3 s" for e in (absent, held)]

    def reported() -> bool:
        states = [status for array in list(reports) for status in array.status]
        return any(s.level == DiagnosticStatus.WARN and s.message == expected[1] for s in states)

    wait_until(reported, "the reason in /diagnostics")
    node.device.answers.append(None)
    wait_until(lambda: node.active, "the node active")
    assert node.device.attempts > 6
    assert node.closed == node.device.attempts - 1
    assert (node.waiting, node.failure) == ("", "")

    lines = [line.split("]: ")[-1] for line in capfd.readouterr().err.splitlines()]
    assert [line for line in lines if "waiting" in line] == expected


def test_after_a_failure_in_operation_nothing_restarts(run) -> None:
    node = run(None)
    wait_until(lambda: node.active, "the node active")
    node.fault("device lost: unplugged")
    wait_until(lambda: node.state_label == "unconfigured", "the node unconfigured")
    assert not threading.Event().wait(1.0)
    assert node.device.attempts == 1
    assert node.state_label == "unconfigured"
    assert (node.waiting, node.failure) == ("", "device lost: unplugged")


def test_a_wrong_setting_is_not_retried(run) -> None:
    node = run(ArgumentError("driver 'magic' is unknown"))
    wait_until(lambda: node.failure, "the failure")
    assert not threading.Event().wait(1.0)
    assert node.device.attempts == 1
    assert node.waiting == ""
    assert "magic" in node.failure
