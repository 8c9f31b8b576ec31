"""One scan through the action, all nodes in one process."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.action import ActionClient
from sensor_msgs.msg import PointCloud2

from eschorty_ros.action import Scan
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE
from eschorty_ros.nodes.one_process.action_job import (
    Feedback,
    bench_options,
    bench_parameters,
    result,
)
from eschorty_ros.nodes.one_process.composition import (
    START_S,
    Composition,
    Tables,
    composition,
    wait,
)
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.cloud_messages import points_from_message


@dataclass(frozen=True, slots=True)
class OneScan:
    """What to scan and how; mm and mm/s.

    ``as_built`` is the build on the emulated bench, where it is not as ``calibration`` says.
    ``hardware`` are parameters of the nodes of real devices, as ``read_hardware`` gives them;
    without it the devices are emulated.
    """

    scene: str
    calibration: str
    start_mm: float
    stop_mm: float
    speed_mm_s: float
    frequency_hz: float
    seed: int = 0
    pixels: str = "paper"
    as_built: str = ""
    hardware: Tables | None = None

    @property
    def sweep_s(self) -> float:
        """Time between start and stop at the scan's speed."""
        return abs(self.stop_mm - self.start_mm) / self.speed_mm_s


@dataclass(frozen=True, slots=True)
class Outcome:
    """The action's result and the cloud (POINT_DTYPE, REFLECTANCE_DTYPE) as on `scan/points`."""

    success: bool
    message: str
    points: NDArray[np.void]
    profiles: int
    events: int
    packets_lost: int
    events_dropped: int


def parameters(scan: OneScan) -> Tables:
    """Parameters of every node for a scan."""
    tables = bench_parameters() if scan.hardware is None else {**scan.hardware}
    tables["reconstruction"] = {
        "calibration": scan.calibration,
        **tables.get("reconstruction", {}),
    }
    return tables


class Instrument:
    """A client of the scan action of running nodes."""

    def __init__(self, running: Composition) -> None:
        self._running = running
        self._clouds: list[PointCloud2] = []
        self._action: ActionClient[Any, Any, Any] = ActionClient(running.client, Scan, "scan")
        running.client.create_subscription(
            PointCloud2, "scan/points", self._clouds.append, qos.latched()
        )

    def scan(self, scan: OneScan, feedback: Feedback) -> Outcome:
        """Send one scan and wait for its end.

        Raises
        ------
        DeviceError
            When the scanner does not answer, refuses the goal or takes far too long.
        """
        feedback(0.0, "starting")
        self._running.wait_until_active(self._action)
        goal = Scan.Goal(
            start=scan.start_mm * 1e-3,
            stop=scan.stop_mm * 1e-3,
            speed=scan.speed_mm_s * 1e-3,
            frequency=scan.frequency_hz,
        )

        def on_feedback(message: Any) -> None:
            state = message.feedback
            feedback(float(state.progress), f"{state.phase} {state.points:,} points")

        before = len(self._clouds)
        ended = result(self._action, goal, on_feedback, 5.0 * scan.sweep_s)
        if ended.points:
            # The newest may still be that of a scan before.
            wait(
                lambda: len(self._clouds) > before and self._clouds[-1].width == ended.points,
                START_S,
                "no cloud of this scan came on scan/points",
            )
        return Outcome(
            bool(ended.success),
            str(ended.message),
            _cloud_points(self._clouds if ended.points else []),
            int(ended.profiles),
            int(ended.events),
            int(ended.packets_lost),
            int(ended.events_dropped),
        )


@contextlib.contextmanager
def instrument(scan: OneScan) -> Iterator[Instrument]:
    """All nodes for one scan; on leaving, whatever happened, the laser is off."""
    bench = bench_options(scan) if scan.hardware is None else None
    with composition(parameters(scan), bench) as running:
        yield Instrument(running)


def _cloud_points(clouds: list[PointCloud2]) -> NDArray[np.void]:
    if not clouds:
        return np.empty(0, POINT_DTYPE)
    seen = points_from_message(clouds[-1])
    names = seen.dtype.names or ()
    points = np.empty(len(seen), REFLECTANCE_DTYPE if "reflectance" in names else POINT_DTYPE)
    for name in points.dtype.names or ():
        points[name] = seen[name]
    return points
