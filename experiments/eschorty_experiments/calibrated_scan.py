"""An instrument that is not as designed, scanned before and after it was calibrated on posts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import FitError
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.calibration import (
    CalibrationReport,
    KnownTarget,
    Targets,
    calibrate,
    recorded_moving_target,
    recorded_posts,
)
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, RangeModel, load_calibration
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.core.storage import Recording
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)
from eschorty_ros.report.figures import new_figure
from eschorty_ros.simulation.scenes import Plane, Posts, Scene, Steps
from eschorty_ros.simulation.world import simulate_recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DESIGN, AS_BUILT = "config_3", "config_3_as_built"
FREQUENCY_HZ, SPEED_MM_S = 70.0, 50.0
CHECK_MM = np.linspace(800.0, 2100.0, 131)
LEVELS_MM = tuple(np.linspace(850.0, 2050.0, 9).tolist())
MOVED_COLUMNS, MOVED_SPEED_MM_S = 64, 100.0
MOVED_MM = (850.0, 1800.0)
MOVED_TRAVEL_MM = (10.0, 210.0)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan of the staircase, reconstructed with two calibrations; mm, shape (n,)."""

    true_mm: Array
    before_mm: Array
    after_mm: Array


def run(effort: Effort, progress: Progress) -> Outcome:
    """Calibrate on nine posts, and on a target moved by the stage; scan a staircase."""
    design, built = load_calibration(DESIGN), load_calibration(AS_BUILT)
    progress(0.0, "posts")
    report = calibrate(_posts(effort, design, built), design)
    progress(0.3, "staircase")
    scan = _staircase(effort, design, built, report.calibration)
    progress(0.6, "target moved by the stage")
    moved = calibrate(_moved(effort, design, built), _narrow(design))
    truth = built.model()
    near, *_, far = Posts().posts
    return Outcome(
        findings=_findings(report, moved, scan, design.model(), truth),
        tables={"levels": _table(scan)},
        figures={"before_after": _figure(scan, report, design.model(), truth)},
        captions={
            "before_after": "Range error of a staircase of nine levels, every point of the scan. "
            "Above: calculated with the design; the line is the error due to the difference of the "
            "builds. Below: calculated with the calibration on nine posts; circles are medians, "
            "the line is the calibration's own error and the band its stated standard deviation.",
            "levels": "Errors by level: median over the points, and median of their magnitude",
        },
        remarks=[
            "As built kk' is 4 % smaller and b' 40 px nearer 0 than designed; posts, staircase and "
            "moved target are simulated with the event pixels of the preset paper, the truth is "
            "known.",
            f"The posts are at {near.range_mm:.0f} to {far.range_mm:.0f} mm and are found "
            "in the sum of all events. The target moved by the stage is swept back and forth "
            "at two places, with one known range per profile.",
        ],
    )


def rms_mm(model: RangeModel, truth: RangeModel) -> float:
    """Return the RMS error of ranges calculated with ``model``, 0.8 to 2.1 m."""
    error = model.range_mm(truth.row(CHECK_MM)) - CHECK_MM
    return float(np.sqrt(np.mean(error**2)))


def _record(
    folder: str,
    scene: Scene,
    build: Calibration,
    travel_mm: tuple[float, float],
    speed_mm_s: float,
    seed: int,
) -> Recording:
    return simulate_recording(
        Path(folder), scene, build, Modulation(FREQUENCY_HZ), *travel_mm, speed_mm_s, seed
    )


def _posts(effort: Effort, design: Calibration, built: Calibration) -> Targets:
    scene = Posts()
    known = [KnownTarget(post.range_mm, size_mm=post.size_mm) for post in scene.posts]
    with TemporaryDirectory(prefix="eschorty_") as folder:
        travel_mm = (0.0, float(effort.choose(50, 15)))
        recording = _record(folder, scene, built, travel_mm, SPEED_MM_S, effort.seed)
        match = recorded_posts(recording.events_path, known, design)
    if match.targets is None:
        raise FitError("no post of the simulated scene was found; " + "; ".join(match.rejected))
    return match.targets


def _staircase(
    effort: Effort, design: Calibration, built: Calibration, calibrated: Calibration
) -> Scan:
    base_mm = LEVELS_MM[0]
    levels = tuple(level - base_mm for level in LEVELS_MM)
    scene = Steps(base_mm, column_levels_mm=levels, stage_levels_mm=(0.0,))
    with TemporaryDirectory(prefix="eschorty_") as folder:
        travel_mm = (10.0, 10.0 + effort.choose(50, 10))
        recording = _record(folder, scene, built, travel_mm, SPEED_MM_S, effort.seed + 1)
        read = [
            reconstruct_recording(replace(recording, calibration=calibration)).profiles
            for calibration in (design, calibrated)
        ]
    truth = scene.range_mm([0.0], np.arange(built.columns), built.model())[0]
    # Rows do not depend on the calibration: both have the same points.
    true_mm = truth[read[0].column]
    return Scan(true_mm, read[0].range_mm - true_mm, read[1].range_mm - true_mm)


def _moved(effort: Effort, design: Calibration, built: Calibration) -> Targets:
    parts: list[Targets] = []
    for at_zero_mm in MOVED_MM:
        for travel_mm in (MOVED_TRAVEL_MM, MOVED_TRAVEL_MM[::-1]):
            with TemporaryDirectory(prefix="eschorty_") as folder:
                scene = Plane(at_zero_mm, slope_stage=1.0)
                seed = effort.seed + 2 + len(parts)
                recording = _record(
                    folder, scene, _narrow(built), travel_mm, MOVED_SPEED_MM_S, seed
                )
                parts.append(recorded_moving_target(recording, _narrow(design), at_zero_mm))
    return Targets.concatenate(parts)


def _narrow(build: Calibration) -> Calibration:
    """Return the build with the few columns that suffice for a flat target."""
    return replace(build, columns=MOVED_COLUMNS, principal_column=None)


def _findings(
    report: CalibrationReport,
    moved: CalibrationReport,
    scan: Scan,
    design: RangeModel,
    truth: RangeModel,
) -> list[Finding]:
    levels = _level_medians(scan.true_mm, scan.after_mm)
    return [
        Finding("posts found and used", float(report.used.sum()), 9.0, 9.0),
        Finding("range as designed, RMS over 0.8-2.1 m", rms_mm(design, truth), 20.0, 99.0, "mm"),
        Finding("range calibrated on nine posts, RMS over 0.8-2.1 m",
                rms_mm(report.fit.model, truth), high=1.0, unit="mm"),
        Finding("range calibrated on a target moved by the stage, RMS over 0.8-2.1 m",
                rms_mm(moved.fit.model, truth), high=0.2, unit="mm"),
        Finding("staircase as designed, median |error|",
                float(np.median(np.abs(scan.before_mm))), 20.0, 99.0, "mm"),
        Finding("staircase calibrated, median |error|",
                float(np.median(np.abs(scan.after_mm))), high=1.0, unit="mm"),
        Finding("staircase calibrated, largest median error of a level",
                float(np.abs(levels).max()), high=1.0, unit="mm"),
    ]  # fmt: skip


def _level_medians(true_mm: Array, error_mm: Array) -> Array:
    return np.array([np.median(error_mm[true_mm == level]) for level in LEVELS_MM])


def _table(scan: Scan) -> DataTable:
    rows: list[list[float | int | str]] = []
    for level in LEVELS_MM:
        at = scan.true_mm == level
        before, after = scan.before_mm[at], scan.after_mm[at]
        rows.append([level, int(at.sum()), *(float(np.median(v)) for v in
                     (before, after, np.abs(after)))])  # fmt: skip
    return DataTable(["range_mm", "points", "before_mm", "after_mm", "after_abs_mm"], rows)


def _figure(scan: Scan, report: CalibrationReport, design: RangeModel, truth: RangeModel) -> Figure:
    figure = new_figure(9.0, 6.5)
    above, below = figure.subplots(2, 1, sharex=True)
    rng = np.random.default_rng(0)
    # Points of a level have one true range and would overlap.
    x_mm = scan.true_mm + rng.uniform(-30.0, 30.0, scan.true_mm.size)
    row = truth.row(CHECK_MM)
    for axes, error_mm, model, name in (
        (above, scan.before_mm, design, "as designed"),
        (below, scan.after_mm, report.fit.model, "calibrated on nine posts"),
    ):
        medians = _level_medians(scan.true_mm, error_mm)
        axes.plot(x_mm, error_mm, ",", color="tab:blue", alpha=0.3, rasterized=True)
        axes.plot(LEVELS_MM, medians, "o", color="black", ms=5, label="median of a level")
        axes.plot(CHECK_MM, model.range_mm(row) - CHECK_MM, color="tab:orange",
                  label="error of the curve alone")  # fmt: skip
        axes.set_ylabel(f"range error {name} (mm)")
        axes.grid(alpha=0.3)
    sigma = report.fit.range_sigma_mm(CHECK_MM)
    below.fill_between(CHECK_MM, -sigma, sigma, color="tab:orange", alpha=0.2,
                       label="stated standard deviation")  # fmt: skip
    limit = float(np.quantile(np.abs(scan.after_mm), 0.999))
    below.set_ylim(-limit, limit)
    below.set_xlabel("true range (mm)")
    for axes in (above, below):
        axes.legend(loc="lower left", fontsize=9)
    return figure


EXPERIMENT = Experiment("calibrated_scan", "Scan before and after calibration", run)
