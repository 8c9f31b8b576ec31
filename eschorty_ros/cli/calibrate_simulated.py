"""`eschorty calibrate --fake`: all nodes, a simulated instrument that is not as designed."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click
import numpy as np

from eschorty_ros.cli.console import pairs, progress_bar
from eschorty_ros.cli.instrument import ended_by_signals, nodes_module
from eschorty_ros.core.base.errors import FitError

if TYPE_CHECKING:
    from eschorty_ros.core.calibration import KnownTarget, Method
    from eschorty_ros.core.optics import Calibration

CHECK_MM = np.linspace(800.0, 2100.0, 131)


def calibrate_simulated(
    known: list[KnownTarget], nominal: str, as_built: str, method: Method, out: Path
) -> None:
    """Calibrate through the action; write the calibration, the picture and the errors.

    Parameters
    ----------
    known : list of KnownTarget
        What is known of the scene ``posts``.
    nominal, as_built : str
        The build as designed, and as the simulated world has it.
    method : {"joint", "paper"}
    out : path
        Calibration to write; its page goes beside it as .html, the sum of all events as .png.

    Raises
    ------
    FitError
        When the calibration failed; nothing is written.
    EschortyError
        Without ROS 2.
    """
    one_calibration = nodes_module("one_process.calibration", make="test")
    from matplotlib.image import imsave

    from eschorty_ros.cli.calibration_output import finish
    from eschorty_ros.core.calibration import calibrate
    from eschorty_ros.core.optics import load_calibration

    design, built = load_calibration(nominal), load_calibration(as_built)
    with ended_by_signals(), TemporaryDirectory(prefix="eschorty_") as folder:
        job = one_calibration.OneCalibration(
            tuple(known), folder, calibration=nominal, as_built=as_built, method=method
        )
        with progress_bar("calibrating") as feedback:
            outcome = one_calibration.calibrate_once(job, feedback)
    if outcome.calibration is None or outcome.targets is None:
        raise FitError(outcome.message)
    report = calibrate(outcome.targets, design, method, date=outcome.calibration.date)
    finish(report, {"targets from": "nine simulated posts", "design": nominal}, out)
    shown = {f"target {entry.label}: {entry.reason}" for entry in report.rejected}
    for line in outcome.rejected:
        if line not in shown:
            click.echo(f"rejected: {line}")
    picture = out.with_suffix(".png")
    imsave(picture, outcome.frame, cmap="gray", vmin=0, vmax=255)
    _print_errors(picture, design, report.calibration, built)


def _print_errors(
    picture: Path, design: Calibration, made: Calibration, built: Calibration
) -> None:
    true_row = built.model().row(CHECK_MM)

    def rms_mm(calibration: Calibration) -> str:
        error = calibration.model().range_mm(true_row) - CHECK_MM
        return f"{float(np.sqrt(np.mean(error**2))):.2f} mm"

    pairs(
        str(picture),
        {
            "range RMS 0.8-2.1 m, as designed": rms_mm(design),
            "range RMS 0.8-2.1 m, calibrated": rms_mm(made),
        },
    )
