"""One calibration through the action, all nodes in one process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.action import ActionClient

from eschorty_ros.action import Calibrate
from eschorty_ros.core.calibration import KnownTarget, Targets, read_targets
from eschorty_ros.core.optics import Calibration, load_calibration
from eschorty_ros.nodes.one_process.action_job import (
    Feedback,
    bench_options,
    bench_parameters,
    result,
)
from eschorty_ros.nodes.one_process.composition import Tables, composition
from eschorty_ros.nodes.reconstruction.active_calibration import targets_path
from eschorty_ros.nodes.reconstruction.calibration_messages import target_message


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
    """The action's ended.

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
    tables = bench_parameters()
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

        ended = result(action, goal, on_feedback, 5.0 * job.capture_s)
    return CalibrationOutcome(
        success=bool(ended.success),
        message=str(ended.message),
        calibration=load_calibration(ended.file) if ended.success else None,
        file=str(ended.file),
        verdicts=tuple(ended.verdicts),
        rejected=tuple(ended.rejected),
        targets=read_targets(targets_path(Path(ended.file))) if ended.success else None,
        frame=np.frombuffer(ended.frame.data, np.uint8).reshape(
            ended.frame.height, ended.frame.width
        ),
    )
