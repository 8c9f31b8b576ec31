"""`eschorty calibrate --fake`: all nodes, a simulated instrument that is not as designed."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from eschorty_ros.cli.console import pairs, progress_bar
from eschorty_ros.cli.instrument import ended_by_signals, one_process
from eschorty_ros.core.errors import FitError

if TYPE_CHECKING:
    from eschorty_ros.core.calibration import Calibration
    from eschorty_ros.core.posts import KnownTarget
    from eschorty_ros.nodes.one_process import CalibrationOutcome

CHECK_MM = np.linspace(800.0, 2100.0, 131)


def calibrate_simulated(
    known: list[KnownTarget], nominal: str, as_built: str, method: str, out: Path
) -> None:
    """Calibrate through the action; write the calibration, the picture and the errors.

    Parameters
    ----------
    known : list of KnownTarget
        What is known of the scene ``posts``.
    nominal, as_built : str
        The build as designed, and as the simulated world has it.
    method : str
    out : path
        Calibration to write; the sum of all events goes beside it as .png.

    Raises
    ------
    FitError
        When the calibration failed; nothing is written.
    EschortyError
        Without ROS 2.
    """
    nodes = one_process("test")
    from eschorty_ros.core.calibration import load_calibration, save_calibration

    design, built = load_calibration(nominal), load_calibration(as_built)
    with ended_by_signals(), TemporaryDirectory(prefix="eschorty_") as folder:
        job = nodes.OneCalibration(
            tuple(known), folder, calibration=nominal, as_built=as_built, method=method
        )
        with progress_bar("calibrating") as report:
            outcome = nodes.calibrate_once(job, report)
    if outcome.calibration is None:
        raise FitError(outcome.message)
    save_calibration(outcome.calibration, out)
    _picture(outcome, out.with_suffix(".png"))
    _print(outcome, design, built, out)


def _picture(outcome: CalibrationOutcome, path: Path) -> None:
    from matplotlib.image import imsave

    imsave(path, outcome.frame, cmap="gray", vmin=0, vmax=255)


def _print(outcome: CalibrationOutcome, design: Calibration, built: Calibration, out: Path) -> None:
    assert outcome.calibration is not None
    true_row = built.model().row(CHECK_MM)

    def rms_mm(calibration: Calibration) -> str:
        error = calibration.model().range_mm(true_row) - CHECK_MM
        return f"{float(np.sqrt(np.mean(error**2))):.2f} mm"

    pairs(
        f"{out}, {out.with_suffix('.png')}",
        {
            "calibration": outcome.calibration.id or "",
            "targets used": f"{len(outcome.row)}",
            "residual": f"{outcome.calibration.residual_rms_px or 0.0:.3f} px",
            "range RMS 0.8-2.1 m, as designed": rms_mm(design),
            "range RMS 0.8-2.1 m, calibrated": rms_mm(outcome.calibration),
        },
    )
    for line in outcome.rejected:
        print(f"rejected: {line}")
    for line in outcome.verdicts:
        print(f"verdict: {line}")
