"""One calibration through the action, all nodes in one process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.action import Calibrate
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.calibration import KnownTarget, Targets, read_targets
from eschorty_ros.core.optics import Calibration, load_calibration
from eschorty_ros.nodes.one_process.composition import bench_parameters, composition
from eschorty_ros.nodes.reconstruction.active_calibration import targets_path
from eschorty_ros.nodes.reconstruction.calibration_messages import target_message


@dataclass(frozen=True, slots=True)
class CalibrationJob:
    """A calibration on emulated devices."""

    targets: tuple[KnownTarget, ...]
    """The known targets of the scene."""
    folder: str
    """Folder for the calibration."""
    calibration: str
    as_built: str
    """The build as designed, and that of the simulated world."""
    method: str
    capture_s: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """The action's result."""

    message: str
    """Reason of a failure, ``""`` on success."""
    calibration: Calibration | None
    """As read back from its file."""
    rejected: tuple[str, ...]
    targets: Targets | None
    """The targets found, to which it was fitted."""
    frame: NDArray[np.uint8]
    """Shape (rows, columns). All events of the capture."""


def calibrate_once(job: CalibrationJob, feedback: Progress) -> CalibrationResult:
    """Run all nodes on emulated devices, calibrate once through the action, end them.

    Raises ``DeviceError`` when a node fails, or the action refuses the goal or takes far too long.
    """
    tables = bench_parameters()
    tables["reconstruction"] |= {"calibration": job.calibration, "calibration_folder": job.folder}
    bench = {"scene": "posts", "calibration": job.as_built, "seed": 0}
    with composition(tables, (Calibrate, "calibrate"), bench) as running:
        goal = Calibrate.Goal(
            targets=[target_message(target) for target in job.targets],
            method=job.method,
            capture_time=job.capture_s,
            frequency=70.0,
        )

        def on_feedback(message: Any) -> None:
            state = message.feedback
            feedback(
                float(state.progress),
                state.waits_for or f"{state.phase} {state.matched} of {state.posts} posts known",
            )

        ended = running.result(goal, on_feedback, feedback)
    return CalibrationResult(
        message=str(ended.message),
        calibration=load_calibration(ended.file) if ended.success else None,
        rejected=tuple(ended.rejected),
        targets=read_targets(targets_path(Path(ended.file))) if ended.success else None,
        frame=np.frombuffer(ended.frame.data, np.uint8).reshape(
            ended.frame.height, ended.frame.width
        ),
    )
