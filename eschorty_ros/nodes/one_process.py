"""One scan or one calibration through the same actions, all nodes in one process."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.action import ActionClient
from sensor_msgs.msg import PointCloud2

from eschorty_ros.action import Calibrate, Scan
from eschorty_ros.core.calibration import Calibration, load_calibration
from eschorty_ros.core.cloud import POINT_DTYPE
from eschorty_ros.core.errors import DeviceError
from eschorty_ros.core.posts import KnownTarget
from eschorty_ros.core.targets import Targets
from eschorty_ros.core.targets_file import read_targets
from eschorty_ros.nodes import qos
from eschorty_ros.nodes.active_calibration import targets_path
from eschorty_ros.nodes.calibration_messages import target_message
from eschorty_ros.nodes.cloud_messages import points_from_message
from eschorty_ros.nodes.composition import (
    START_S,
    Composition,
    Tables,
    composition,
    lossless_events,
    wait,
)
from eschorty_ros.nodes.hardware_file import read_hardware

__all__ = ["OneCalibration", "OneScan", "calibrate_once", "instrument", "read_hardware"]

SLACK_S = 60.0

Feedback = Callable[[float, str], None]


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
    """The action's result and the cloud (POINT_DTYPE) as it came over `scan/points`."""

    success: bool
    message: str
    points: NDArray[np.void]
    profiles: int
    events: int
    packets_lost: int
    events_dropped: int


def parameters(scan: OneScan) -> Tables:
    """Parameters of every node for a scan."""
    tables = _at_the_bench() if scan.hardware is None else {**scan.hardware}
    tables["reconstruction"] = {
        "calibration": scan.calibration,
        **tables.get("reconstruction", {}),
    }
    return tables


def _at_the_bench() -> Tables:
    """Parameters for a bench whose stage triggers the camera."""
    tables = lossless_events()
    tables["camera"]["trigger_in_mode"] = "external"
    tables["reconstruction"]["trigger_source"] = "stage"
    return tables


def bench_options(job: OneScan | OneCalibration) -> dict[str, object]:
    """Options of the bench on which the job is done; its stage triggers the camera."""
    return {
        "scene": job.scene,
        "calibration": job.as_built or job.calibration,
        "seed": job.seed,
        "pixels": job.pixels,
        "trigger": "stage",
    }


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

        result = _result(self._action, goal, on_feedback, 5.0 * scan.sweep_s)
        if result.points:
            wait(lambda: bool(self._clouds), START_S, "no cloud came on scan/points")
        return Outcome(
            bool(result.success),
            str(result.message),
            _cloud_points(self._clouds),
            int(result.profiles),
            int(result.events),
            int(result.packets_lost),
            int(result.events_dropped),
        )


@contextlib.contextmanager
def instrument(scan: OneScan) -> Iterator[Instrument]:
    """All nodes for one scan; on leaving, whatever happened, the laser is off."""
    bench = bench_options(scan) if scan.hardware is None else None
    with composition(parameters(scan), bench) as running:
        yield Instrument(running)


@dataclass(frozen=True, slots=True)
class OneCalibration:
    """What to calibrate with.

    Attributes
    ----------
    targets : tuple of KnownTarget
        What the scene holds, as far as the calibration is told.
    scene : str
    calibration : str
        The build as designed.
    as_built : str
        The build the simulated world has.
    method : {"joint", "paper"}
    capture_s, frequency_hz : float
    seed : int
    pixels : str
        Preset of the pixels.
    folder : str
        Where the calibration is written.
    """

    targets: tuple[KnownTarget, ...]
    folder: str
    scene: str = "posts"
    calibration: str = "config_3"
    as_built: str = "config_3_as_built"
    method: str = "joint"
    capture_s: float = 1.0
    frequency_hz: float = 70.0
    seed: int = 0
    pixels: str = "paper"


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationOutcome:
    """The action's result.

    Attributes
    ----------
    success : bool
    message : str
        Why not, empty when it succeeded.
    calibration : Calibration or None
        As read back from ``file``.
    file : str
    verdicts, rejected : tuple of str
    targets : Targets or None
        What was found and fitted to.
    frame : ndarray of uint8, shape (rows, columns)
        All events of the capture.
    """

    success: bool
    message: str
    calibration: Calibration | None
    file: str
    verdicts: tuple[str, ...]
    rejected: tuple[str, ...]
    targets: Targets | None
    frame: NDArray[np.uint8]


def calibration_parameters(job: OneCalibration) -> Tables:
    """Parameters of every node for a calibration on emulated devices."""
    tables = _at_the_bench()
    tables["reconstruction"] |= {
        "calibration": job.calibration,
        "calibration_folder": job.folder,
    }
    return tables


def calibrate_once(job: OneCalibration, feedback: Feedback) -> CalibrationOutcome:
    """Run all nodes on emulated devices, calibrate once through the action, end them.

    Parameters
    ----------
    job : OneCalibration
    feedback : callable
        Called with the share done and a line of text.

    Raises
    ------
    DeviceError
        When the nodes do not answer, refuse the goal or take far too long.
    """
    with composition(calibration_parameters(job), bench_options(job)) as running:
        feedback(0.0, "starting")
        action: ActionClient[Any, Any, Any] = ActionClient(running.client, Calibrate, "calibrate")
        running.wait_until_active(action)
        goal = Calibrate.Goal(
            targets=[target_message(target) for target in job.targets],
            method=job.method,
            capture_time=job.capture_s,
            frequency=job.frequency_hz,
        )

        def on_feedback(message: Any) -> None:
            state = message.feedback
            feedback(
                float(state.progress),
                f"{state.phase} {state.matched} of {state.posts} posts known",
            )

        result = _result(action, goal, on_feedback, 5.0 * job.capture_s)
    return CalibrationOutcome(
        success=bool(result.success),
        message=str(result.message),
        calibration=load_calibration(result.file) if result.success else None,
        file=str(result.file),
        verdicts=tuple(result.verdicts),
        rejected=tuple(result.rejected),
        targets=read_targets(targets_path(Path(result.file))) if result.success else None,
        frame=np.frombuffer(result.frame.data, np.uint8).reshape(
            result.frame.height, result.frame.width
        ),
    )


def _result(
    action: ActionClient[Any, Any, Any],
    goal: Any,
    on_feedback: Callable[[Any], None],
    expected_s: float,
) -> Any:
    """Send a goal and wait for its result; whatever interrupts the waiting cancels it."""
    sent = action.send_goal_async(goal, feedback_callback=on_feedback)
    wait(sent.done, START_S, "the action does not answer")
    handle = sent.result()
    if handle is None or not handle.accepted:
        raise DeviceError("the goal was refused; see the message above")
    finished = handle.get_result_async()
    try:
        wait(finished.done, expected_s + SLACK_S, "the action does not end")
    except BaseException:
        handle.cancel_goal_async()
        raise
    return finished.result().result


def _cloud_points(clouds: list[PointCloud2]) -> NDArray[np.void]:
    if not clouds:
        return np.empty(0, POINT_DTYPE)
    seen = points_from_message(clouds[-1])
    points = np.empty(len(seen), POINT_DTYPE)
    for name in POINT_DTYPE.names or ():
        points[name] = seen[name]
    return points
