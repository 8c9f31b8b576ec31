"""Effects of the world: what ambient light, defocus, ghosts and others do to a scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_experiments._scan_errors import scan_errors
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, reconstruct_recording
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)
from eschorty_ros.report.figures import new_figure
from eschorty_ros.simulation.scenes import Plane, Scene, Steps
from eschorty_ros.simulation.world import Effects, simulate_recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RANGE_MM, SLOPE = 1320.0, 0.1
"""A plane at an angle, so that the line crosses the pixel rows at every phase."""
START_MM, SPEED_MM_S = 40.0, 50.0
STEP_MM = 60.0
"""Stage position of the occluding step."""
LINE_MM = 4.0
"""More than half of the line's thickness."""
SWEEPS: dict[str, tuple[str, tuple[float, ...]]] = {
    "ambient": ("ambient={:g}", (0.0, 0.1, 0.3, 1.0, 3.0)),
    "defocus": ("defocus_mm={:g}", (0.0, 10.0, 20.0, 40.0, 80.0)),
    "ghost": ("ghost={:g},ghost_mm=16", (0.0, 0.2, 0.4, 0.6, 0.8)),
    "readout": ("row_time_us={:g}", (0.5, 2.0, 5.0, 10.0, 20.0)),
}
FALLOFF_MM = (900.0, RANGE_MM, 1600.0, 1900.0)
LABELS = {
    "ambient": "ambient light over the line's peak",
    "falloff": "range (mm)",
    "defocus": "distance of the plane in focus from the sheet (mm)",
    "ghost": "light of a second sheet, 16 mm beside, over the first one's",
    "readout": "time that the readout spends on a row (us)",
}


class Scanned(NamedTuple):
    """Points of one scan and their errors."""

    profiles: Profiles
    stage_mm: NDArray[np.float64]
    median_mm: float
    p95_mm: float
    gross: float
    complete: float
    within: float

    @property
    def figures(self) -> list[float]:
        """Return the numbers for a table."""
        return [round(float(value), 3) for value in self[2:]]


def run(effort: Effort, progress: Progress) -> Outcome:
    """Scan a plane, and a step for the occlusion, under every effect at several strengths."""
    outcome = Outcome(remarks=list(_REMARKS))
    plane = Plane(RANGE_MM, slope_column=SLOPE)
    curves: dict[str, dict[str, list[tuple[float, Scanned]]]] = {}
    for name, (text, strengths) in SWEEPS.items():
        progress(0.15 * len(curves), name)
        scans = [(value, _scan(plane, text.format(value), effort)) for value in strengths]
        curves[name] = {"": scans}
    progress(0.6, "falloff")
    curves["falloff"] = {
        label: [(r, _scan(Plane(r, slope_column=SLOPE), text, effort)) for r in FALLOFF_MM]
        for label, text in (
            ("without falloff", "none"),
            ("with falloff", f"falloff_mm={RANGE_MM:g}"),
        )
    }
    progress(0.9, "occlusion")
    step = Steps(RANGE_MM, (0.0,), (-100.0, 0.0), STEP_MM)
    lit = [_scan(step, text, effort, STEP_MM - 5.0, 25.0) for text in ("none", "occlusion=1")]
    for name, label in LABELS.items():
        outcome.figures[name] = _figure(curves[name], label)
        outcome.captions[name] = f"Errors and coverage of a plane against the {label}"
    outcome.figures["occlusion"] = _step_figure(lit, step)
    outcome.captions["occlusion"] = "One column of a step of 100 mm, with and without occlusion"
    rows: list[list[float | str]] = [
        [label or name, value, *one.figures]
        for name, both in curves.items()
        for label, scans in both.items()
        for value, one in scans
    ]
    rows += [["occlusion", float(k), *one.figures] for k, one in enumerate(lit)]
    outcome.tables["effects"] = DataTable(
        ["effect", "value", "median_mm", "p95_mm", "gross_share", "complete", "within_1_sigma"],
        rows,
    )
    outcome.captions["effects"] = "Every scan of this part"
    outcome.findings.extend(_findings(curves, lit))
    return outcome


def _scan(
    scene: Scene, text: str, effort: Effort, start_mm: float = START_MM, travel_mm: float = 0.0
) -> Scanned:
    columns = effort.choose(640, 96)
    build = replace(load_calibration("config_3"), columns=columns, principal_column=None)
    effects = Effects.parse(text)
    with TemporaryDirectory(prefix="eschorty_") as folder:
        recording = simulate_recording(
            Path(folder),
            scene,
            build,
            Modulation(70.0),
            start_mm,
            start_mm + (travel_mm or effort.choose(20, 8)),
            SPEED_MM_S,
            effort.seed,
            effects=effects,
        )
        profiles = reconstruct_recording(recording).profiles
        errors = scan_errors(profiles, recording, effects.scene(scene, build.model()))
        stage_mm = np.asarray(recording.stage.position_mm(profiles.t_us))
    known = np.isfinite(errors.error_mm)
    ratio = np.abs(errors.error_mm[known]) / profiles.sigma_mm[known]
    return Scanned(
        profiles,
        stage_mm,
        errors.median_mm,
        errors.quantile_mm(0.95),
        errors.gross_share,
        errors.completeness,
        float(np.mean(ratio <= 1.0)) if ratio.size else np.nan,
    )


def _findings(
    curves: dict[str, dict[str, list[tuple[float, Scanned]]]], lit: list[Scanned]
) -> list[Finding]:
    at = {name: dict(list(both.values())[-1]) for name, both in curves.items()}
    # The shadow of the step, without what the line's thickness lights on either side of it.
    along_mm, lens_mm = load_calibration("config_3").model().pupil_mm
    low, high = STEP_MM + LINE_MM, STEP_MM + 100.0 * lens_mm / (RANGE_MM - along_mm) - LINE_MM
    plain = at["ambient"][0.0].median_mm
    dark = [int(np.sum((one.stage_mm > low) & (one.stage_mm < high))) for one in lit]
    return [
        Finding("ambient light as bright as the line: median error over that without",
                at["ambient"][1.0].median_mm / plain, high=1.6),
        Finding("ambient light as bright as the line: completeness",
                at["ambient"][1.0].complete, low=0.98),
        Finding("falloff: median error at 1.9 m, in rows",
                at["falloff"][1900.0].median_mm / _row_mm(1900.0), high=0.2, unit="px"),
        Finding("40 mm out of focus: median error over that in focus",
                at["defocus"][40.0].median_mm / plain, high=1.4),
        Finding("ghost of 0.4: gross errors", at["ghost"][0.4].gross, high=0.0),
        Finding("occlusion: points inside the shadow of a step, over those without occlusion",
                dark[1] / dark[0], high=0.0),
        Finding("rows of 5 us: median error over that of 0.5 us",
                at["readout"][5.0].median_mm / plain, high=1.2),
    ]  # fmt: skip


def _row_mm(range_mm: float) -> float:
    return float(load_calibration("config_3").model().range_per_row_mm(range_mm))


def _figure(both: dict[str, list[tuple[float, Scanned]]], label: str) -> Figure:
    figure = new_figure(9.0, 3.6)
    error, share = figure.subplots(1, 2)
    for name, scans in both.items():
        x = [value for value, _ in scans]
        style = "--" if name == "without falloff" else "-"
        kind = f", {name}" if name else ""
        error.plot(x, [one.median_mm for _, one in scans], "o" + style, color="tab:blue",
                   label=f"median{kind}")  # fmt: skip
        error.plot(x, [one.p95_mm for _, one in scans], "s" + style, color="tab:orange",
                   label=f"95th percentile{kind}")  # fmt: skip
        share.plot(x, [one.complete for _, one in scans], "o" + style, color="tab:green",
                   label=f"complete{kind}")  # fmt: skip
        share.plot(x, [one.within for _, one in scans], "s" + style, color="tab:red",
                   label=f"within 1 sigma{kind}")  # fmt: skip
    error.set(ylabel="error (mm)", yscale="log")
    share.set(ylabel="share of the points", ylim=(0.0, 1.05))
    for axes in (error, share):
        axes.legend(fontsize="small")
        axes.grid(alpha=0.3)
    figure.supxlabel(label)
    return figure


def _step_figure(lit: list[Scanned], step: Scene) -> Figure:
    figure = new_figure(9.0, 3.6)
    axes = figure.add_subplot()
    model = load_calibration("config_3").model()
    at_mm = np.linspace(STEP_MM - 5.0, STEP_MM + 20.0, 501)
    axes.plot(at_mm, step.range_mm(at_mm, [0], model)[:, 0], "k-", lw=1.0, label="scene")
    for one, marker, label in zip(lit, "ox", ("all visible", "occlusion"), strict=True):
        mine = one.profiles.column == int(np.median(one.profiles.column))
        axes.plot(one.stage_mm[mine], one.profiles.range_mm[mine], marker, ms=5, label=label)
    axes.set(xlabel="stage position (mm)", ylabel="range (mm)")
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


_REMARKS = (
    "A pixel that compares logarithms loses contrast under ambient light: the line is narrower, "
    "its error larger. Out of focus the line is wider and dimmer, and hardly worse. A second sheet "
    "of 0.6 or more of the light gives nearly as many events as the first one, since the number of "
    "events follows the logarithm of the light: then no window shows which one is real, and "
    "`returns` has to choose.",
    "Beside a step the sheet lights surfaces that the camera, 0.18 m from it, does not see: there "
    "are no points. Where the line leaves the shadow a part of it is seen, as at a step.",
    "A row costs the readout its time for a single event, too: with the background of all 640 "
    "columns it saturates at 10 us, with that of 1280 at 5 us. Then events wait, merge and are "
    "lost.",
)
EXPERIMENT = Experiment("effects", "Effects of the world on a scan", run)
