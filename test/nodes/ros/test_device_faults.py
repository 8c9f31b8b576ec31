"""A device that fails while its node is active: reported, closed, unconfigured."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from benches import bench_here
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros_process import Observer, nodes_here, wait_until

from eschorty_ros.nodes.laser.node import LaserNode
from eschorty_ros.nodes.ros import lifecycle, qos
from eschorty_ros.nodes.ros.lifecycle import DeviceNode
from eschorty_ros.nodes.stage.node import StageNode


@pytest.mark.parametrize(("kind", "name"), [(LaserNode, "laser"), (StageNode, "stage")])
def test_a_lost_device_is_reported_closed_and_not_opened_again(
    kind: type[DeviceNode], name: str, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lifecycle, "RETRY_S", 0.2)
    with bench_here() as (bench, folder), nodes_here(observer.domain, threads=4) as start:
        device, node = getattr(bench, name), start(kind, bench=str(folder))
        wait_until(lambda: node.active, "the node active")
        reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
        device.gone = True
        wait_until(lambda: node.state_label == "unconfigured", "the node unconfigured")
        print(node.failure)
        assert node.failure
        assert "\n" not in node.failure
        reason = node.failure.split(": ")[-1]

        def reported() -> bool:
            every = [status for array in list(reports) for status in array.status]
            return any(s.level == DiagnosticStatus.ERROR and reason in s.message for s in every)

        wait_until(reported, "the failure on /diagnostics")
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
