"""All nodes in one process on simulated hardware, and one scan through the same action."""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from numpy.typing import NDArray
from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from eschorty_ros.action import Scan
from eschorty_ros.core.cloud import POINT_DTYPE
from eschorty_ros.core.errors import DeviceError
from eschorty_ros.nodes import qos
from eschorty_ros.nodes.camera import CameraNode
from eschorty_ros.nodes.cloud_messages import points_from_message
from eschorty_ros.nodes.domain import free_domain
from eschorty_ros.nodes.laser import LaserNode
from eschorty_ros.nodes.reconstruction import ReconstructionNode
from eschorty_ros.nodes.scanner import ScannerNode
from eschorty_ros.nodes.spin import make_safe, turn, undisturbed
from eschorty_ros.nodes.stage import StageNode

NAMESPACE = "/eschorty"
NODES = {
    "camera": CameraNode,
    "laser": LaserNode,
    "stage": StageNode,
    "reconstruction": ReconstructionNode,
    "scanner": ScannerNode,
}
THREADS = 12
START_S = 60.0
SLACK_S = 60.0
_POLL_S = 0.02

Feedback = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class OneScan:
    """What to scan and how; mm and mm/s."""

    scene: str
    calibration: str
    start_mm: float
    stop_mm: float
    speed_mm_s: float
    frequency_hz: float
    seed: int = 0
    pixels: str = "paper"

    @property
    def sweep_s(self) -> float:
        """Time between start and stop at the scan's speed."""
        return abs(self.stop_mm - self.start_mm) / self.speed_mm_s


@dataclass(frozen=True, slots=True)
class Outcome:
    """The action's result and the cloud (POINT_DTYPE) as it came over `scan/points`."""

    success: bool
    message: str
    points: NDArray[np.void]
    profiles: int
    events: int
    packets_lost: int
    events_dropped: int


def parameters(scan: OneScan) -> dict[str, dict[str, Any]]:
    """Parameters of every node for a scan on simulated hardware."""
    topic = f"{NAMESPACE}/camera/events"
    return {
        "camera": {
            "scene": scan.scene,
            "calibration": scan.calibration,
            "seed": scan.seed,
            "pixels": scan.pixels,
            "qos_overrides": {topic: {"publisher": {"reliability": "reliable"}}},
        },
        "reconstruction": {
            "calibration": scan.calibration,
            "qos_overrides": {topic: {"subscription": {"reliability": "reliable"}}},
        },
    }


class Instrument:
    """The nodes, spinning in a thread of this process, and a client of their scan action."""

    def __init__(self, client: Node, nodes: list[Node]) -> None:
        self._client = client
        self._nodes = nodes
        self._clouds: list[PointCloud2] = []
        self._action: ActionClient[Any, Any, Any] = ActionClient(client, Scan, "scan")
        client.create_subscription(PointCloud2, "scan/points", self._clouds.append, qos.latched())

    def scan(self, scan: OneScan, feedback: Feedback) -> Outcome:
        """Send one scan and wait for its end.

        Raises
        ------
        DeviceError
            When the scanner does not answer, refuses the goal or takes far too long.
        """
        feedback(0.0, "starting")
        _wait(self._ready, START_S, "the nodes are not active")
        goal = Scan.Goal(
            start=scan.start_mm * 1e-3,
            stop=scan.stop_mm * 1e-3,
            speed=scan.speed_mm_s * 1e-3,
            frequency=scan.frequency_hz,
        )

        def on_feedback(message: Any) -> None:
            state = message.feedback
            feedback(float(state.progress), f"{state.phase} {state.points:,} points")

        sent = self._action.send_goal_async(goal, feedback_callback=on_feedback)
        _wait(sent.done, START_S, "the scanner does not answer")
        handle = sent.result()
        if handle is None or not handle.accepted:
            raise DeviceError("the scanner refused the scan; see its message above")
        finished = handle.get_result_async()
        try:
            _wait(finished.done, 5.0 * scan.sweep_s + SLACK_S, "the scan does not end")
        except BaseException:
            handle.cancel_goal_async()
            raise
        result = finished.result().result
        if result.points:
            _wait(lambda: bool(self._clouds), START_S, "no cloud came on scan/points")
        return Outcome(
            bool(result.success),
            str(result.message),
            _cloud_points(self._clouds),
            int(result.profiles),
            int(result.events),
            int(result.packets_lost),
            int(result.events_dropped),
        )

    def _ready(self) -> bool:
        failed = [
            f"{node.get_name()}: {reason.splitlines()[-1]}"
            for node in self._nodes
            if (reason := getattr(node, "failure", ""))
        ]
        if failed:
            raise DeviceError("; ".join(failed))
        active = all(getattr(node, "active", True) for node in self._nodes)
        return active and self._action.server_is_ready()


@contextlib.contextmanager
def instrument(scan: OneScan) -> Iterator[Instrument]:
    """All nodes for one scan; on leaving, whatever happened, the laser is off.

    Unless ``ROS_DOMAIN_ID`` is set, the nodes get a domain of their own, so that they meet no
    other instrument.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    nodes: list[Node] = []
    with tempfile.TemporaryDirectory(prefix="eschorty_") as folder:
        file = Path(folder) / "parameters.yaml"
        file.write_text(_parameter_file(parameters(scan)))
        rclpy.init(
            args=[
                "--ros-args",
                *("-r", f"__ns:={NAMESPACE}"),
                *("--params-file", str(file)),
                *("--log-level", "warn"),
            ],
            domain_id=None if os.environ.get("ROS_DOMAIN_ID") else free_domain(),
            signal_handler_options=SignalHandlerOptions.NO,
        )
        executor = MultiThreadedExecutor(THREADS)
        ending = threading.Event()
        thread = threading.Thread(target=_spin, args=(executor, ending), name="nodes")
        try:
            for factory in NODES.values():
                nodes.append(factory())
            nodes.append(client := Node("eschorty_scan"))
            made = Instrument(client, nodes)
            for node in nodes:
                executor.add_node(node)
            thread.start()
            yield made
        finally:
            with undisturbed():
                make_safe(nodes)
                ending.set()
                # An ended context also ends callbacks that wait, such as homing.
                rclpy.try_shutdown()
                if thread.is_alive():
                    thread.join(5.0)
                executor.shutdown(timeout_sec=2.0)
                for node in nodes:
                    node.destroy_node()


def _parameter_file(values: dict[str, dict[str, Any]]) -> str:
    return yaml.safe_dump(
        {f"{NAMESPACE}/{node}": {"ros__parameters": table} for node, table in values.items()}
    )


def _spin(executor: MultiThreadedExecutor, ending: threading.Event) -> None:
    # Shutting an executor down while it spins raises in this thread, so it is asked to end.
    try:
        while not ending.is_set():
            turn(executor)
    except ExternalShutdownException:
        pass
    except Exception:
        # A callback that publishes while the context ends fails; that is no news.
        if not ending.is_set():
            raise


def _wait(condition: Callable[[], Any], limit_s: float, fault: str) -> None:
    # Polled from the main thread, so that Ctrl-C arrives at once.
    end_s = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end_s:
            raise DeviceError(f"{fault} after {limit_s:.0f} s; look at the log above")
        time.sleep(_POLL_S)


def _cloud_points(clouds: list[PointCloud2]) -> NDArray[np.void]:
    if not clouds:
        return np.empty(0, POINT_DTYPE)
    seen = points_from_message(clouds[-1])
    points = np.empty(len(seen), POINT_DTYPE)
    for name in POINT_DTYPE.names or ():
        points[name] = seen[name]
    return points
