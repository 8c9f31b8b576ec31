"""A device that fails while its node is active: reported, closed, unconfigured."""

# ruff: noqa: E402 - without rclpy the file skips before it imports what needs it
from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")

from benches import bench_here
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter
from ros_process import Observer, wait_until
from spinning import spinning

from eschorty_ros.emulation.bench.devices import Bench
from eschorty_ros.nodes.laser.node import LaserNode
from eschorty_ros.nodes.ros import lifecycle, qos
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.nodes.ros.lifecycle import DeviceNode
from eschorty_ros.nodes.stage.node import StageNode

Run = Callable[[type[DeviceNode]], DeviceNode]


@pytest.fixture(scope="module")
def emulated() -> Iterator[tuple[Bench, Path]]:
    with bench_here() as (bench, folder):
        yield bench, folder


@pytest.fixture
def observer() -> Iterator[Observer]:
    with Observer(free_domain(), "fault_observer") as observer:
        yield observer


@pytest.fixture
def run(
    observer: Observer, emulated: tuple[Bench, Path], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Run]:
    monkeypatch.setattr(lifecycle, "RETRY_S", 0.2)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=observer.domain)
    executor = MultiThreadedExecutor(4, context=context)
    nodes: list[DeviceNode] = []
    folder = Parameter("bench", value=str(emulated[1]))

    def start(kind: type[DeviceNode]) -> DeviceNode:
        node = kind(context=context, namespace="eschorty", parameter_overrides=[folder])
        nodes.append(node)
        executor.add_node(node)
        wait_until(lambda: node.active, "the node active")
        return node

    with spinning(executor):
        yield start
        for node in nodes:
            node.safe_state()
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


@pytest.mark.parametrize(("kind", "name"), [(LaserNode, "laser"), (StageNode, "stage")])
def test_a_lost_device_is_reported_closed_and_not_opened_again(
    kind: type[DeviceNode],
    name: str,
    run: Run,
    observer: Observer,
    emulated: tuple[Bench, Path],
) -> None:
    device = getattr(emulated[0], name)
    node = run(kind)
    reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
    device.gone = True
    wait_until(lambda: node.state_label == "unconfigured", "the node unconfigured")
    print(node.failure)
    assert node.failure
    assert "\n" not in node.failure
    reason = node.failure.split(": ")[-1]
    wait_until(
        lambda: any(
            status.level == DiagnosticStatus.ERROR and reason in status.message
            for array in reports
            for status in array.status
        ),
        "the failure on /diagnostics",
    )
    if hasattr(device, "replug"):
        device.replug()
    else:
        device.gone = False
    time.sleep(1.0)
    assert node.state_label == "unconfigured", "nothing starts by itself after a failure"
    # The laser's old guard may still hold the generator while it switches it off.
    wait_until(lambda: observer.change_state(name, "configure"), "the device open again")
    assert observer.change_state(name, "activate")
    assert node.active
