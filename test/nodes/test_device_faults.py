"""What the nodes do when a device fails while active: said once, safe, unconfigured, reported."""

# ruff: noqa: E402 - without rclpy the file skips before it imports what needs it
from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy (ROS 2) is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import MultiThreadedExecutor
from ros_process import Observer, wait_until

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.hardware.protocols import EventChunk
from eschorty_ros.nodes import drivers, qos
from eschorty_ros.nodes.camera import CameraNode
from eschorty_ros.nodes.domain import free_domain
from eschorty_ros.nodes.laser import LaserNode
from eschorty_ros.nodes.lifecycle import DeviceNode
from eschorty_ros.nodes.stage import StageNode
from eschorty_ros.simulation.devices import FakeLaser, FakeStage


class Frail:
    """A device of which one method fails once it is unplugged."""

    def __init__(self, device: Any, method: str) -> None:
        self._device = device
        self._method = method
        self.unplugged = False
        self.calls: list[str] = []

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._device, name)
        self.calls.append(name)
        if name == self._method and self.unplugged:
            raise DeviceError("device unplugged; plug it in and configure again")
        return attribute


class Silent:
    """A camera without events."""

    identity = FakeLaser(lambda: 0).identity
    width, height = 1280, 720

    def read(self, timeout_s: float) -> EventChunk:
        return EventChunk(b"\x00\x80", 0)

    def statistics(self) -> dict[str, float]:
        return {}

    def start(self) -> None: ...

    open = stop = close = start


Run = Callable[[type[DeviceNode]], DeviceNode]


@pytest.fixture
def observer() -> Iterator[Observer]:
    with Observer(free_domain(), "fault_observer") as observer:
        yield observer


@pytest.fixture
def run(observer: Observer) -> Iterator[Run]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=observer.domain)
    executor = MultiThreadedExecutor(4, context=context)
    thread = threading.Thread(target=executor.spin, daemon=True)
    nodes: list[DeviceNode] = []

    def start(kind: type[DeviceNode]) -> DeviceNode:
        node = kind(context=context, namespace="eschorty")
        nodes.append(node)
        executor.add_node(node)
        thread.start()
        wait_until(lambda: node.active, "the node active")
        return node

    yield start
    for node in nodes:
        node.safe_state()
    executor.shutdown()
    thread.join()
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


@pytest.mark.parametrize(
    ("kind", "registry", "device", "method", "last"),
    [
        (CameraNode, drivers.CAMERAS, Silent(), "read", "close"),
        (LaserNode, drivers.LASERS, FakeLaser(lambda: 0), "readback", "close"),
        (StageNode, drivers.STAGES, None, "state", "close"),
    ],
    ids=["camera", "laser", "stage"],
)
def test_lost_device_is_closed_and_reported(
    kind: type[DeviceNode],
    registry: dict[str, Any],
    device: Any,
    method: str,
    last: str,
    run: Run,
    observer: Observer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[Frail] = []

    def make(_: Any, clock_ns: Callable[[], int]) -> Frail:
        made.append(Frail(device or FakeStage(clock_ns), method))
        return made[-1]

    monkeypatch.setitem(registry, "fake", make)
    node = run(kind)
    reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
    made[0].unplugged = True
    wait_until(lambda: node.state_label == "unconfigured", "the node unconfigured")
    assert made[0].calls[-1] == last
    assert "device unplugged" in node.failure
    wait_until(
        lambda: any(
            status.level == DiagnosticStatus.ERROR and "device unplugged" in status.message
            for array in reports
            for status in array.status
        ),
        "the failure on /diagnostics",
    )
    made[0].unplugged = False
    monkeypatch.setitem(registry, "fake", lambda _, clock_ns: device or FakeStage(clock_ns))
