"""Fig. 4: range curves of the builds, calibration points with residuals, magnification."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eschorty_experiments._builds import builds
from eschorty_experiments._posts import (
    POST_MM,
    POSTS,
    SIGMA_ROW_PX,
    Posts,
    measure_posts,
    pulls,
)
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.optics import Design
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)
from eschorty_ros.report.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CALIBRATED = ("config_1", "config_2", "config_3")
# Depth of field over the range step of one row, the same at every range.
FOCUS_ROWS = {"nominal": 14.65, "config_1": 12.97, "config_2": 15.02, "config_3": 14.96}


def run(effort: Effort, progress: Progress) -> Outcome:
    """Calibrate the three builds on simulated posts; repeat to check the stated errors."""
    made = builds()
    measured = {}
    for name, seed in zip(CALIBRATED, _seeds(effort), strict=True):
        measured[name] = measure_posts(made[name], made["nominal"], np.random.default_rng(seed))
    progress(0.2, "repeats")
    drawn, chi_square = _repeats(made, effort)
    progress(0.6, "figures")
    return Outcome(
        findings=[
            *_curve_findings(made, measured),
            *_magnification_findings(made, measured),
            Finding("mean reduced chi square of repeated calibrations", chi_square, 0.88, 1.12),
            Finding("share of repeats whose k' errs by less than its stated sigma",
                    float(np.mean(np.abs(drawn[:, 0]) < 1.0)), 0.58, 0.78),
        ],
        tables={"posts": _posts_table(made, measured), "fits": _fits_table(made, measured)},
        figures={
            "curves": _curves_figure(made, measured),
            "residuals": _residuals_figure(made, measured),
            "magnification": _magnification_figure(made, measured),
        },
        captions={
            "curves": "Range over row (Eq. 2) of the four builds, lines, with the calibration "
            "posts of the three that were built.",
            "residuals": "Residuals of the posts: left in mm against the depth of field (Eq. 3) "
            "and the step of one row (Eq. 4), right in rows, where the noise is the same at every "
            "range. The depth of field is a gate more than ten times too wide.",
            "magnification": f"Magnification from the columns that posts of {POST_MM} mm cover, "
            "and Eq. 1 as lines: slope 1/k', zero at row -b' (range infinite).",
            "posts": "Posts as measured, and their residuals",
            "fits": "Parameters as built, as fitted to rows, and from the magnification",
        },
        remarks=[
            f"{POSTS} posts a build, evenly spaced in range, their rows with Gaussian noise of "
            f"{SIGMA_ROW_PX} px; k and b stay at their design values, as in the paper. The paper "
            "publishes no points: these are simulated from the printed parameters.",
            "Magnification comes from sizes alone, so its slope and zero check k' and b' "
            "independently of the range fit; blooming of the posts' edges is not simulated.",
            "Accept a calibration on residuals up to 3 sigma in rows, not on the depth of field.",
        ],
    )  # fmt: skip


def _seeds(effort: Effort) -> list[np.random.SeedSequence]:
    return np.random.SeedSequence([effort.seed, 4]).spawn(len(CALIBRATED))


def _repeats(made: dict[str, Design], effort: Effort) -> tuple[np.ndarray, float]:
    """Return pulls of k' and b', shape (repeats * builds, 2), and the mean reduced chi square."""
    rng = np.random.default_rng([effort.seed, 41])
    drawn, chi_square = [], []
    for _ in range(effort.choose(400, 80)):
        for name in CALIBRATED:
            posts = measure_posts(made[name], made["nominal"], rng)
            drawn.append(pulls(posts, made[name]))
            chi_square.append(posts.fit.reduced_chi_square)
    return np.array(drawn), float(np.mean(chi_square))


def _curve_findings(made: dict[str, Design], measured: dict[str, Posts]) -> list[Finding]:
    residual = np.concatenate([posts.fit.residual_px for posts in measured.values()])
    rows = np.arange(720.0)
    curve = [
        np.max(np.abs(posts.fit.model.range_mm(rows) - made[name].model.range_mm(rows))
               / made[name].model.range_per_row_mm(made[name].model.range_mm(rows)))
        for name, posts in measured.items()
    ]  # fmt: skip
    focus = [abs(build.depth_of_field_rows - FOCUS_ROWS[name]) for name, build in made.items()]
    least_focus = min(made[name].depth_of_field_rows for name in measured)
    findings = [
        Finding(f"{name}: fitted k' and b', largest error over its stated sigma",
                float(np.max(np.abs(pulls(posts, made[name])))), high=3.0)
        for name, posts in measured.items()
    ]  # fmt: skip
    return [
        *findings,
        Finding("posts with a residual within 3 sigma_row",
                float(np.mean(np.abs(residual) <= 3.0 * SIGMA_ROW_PX)), low=0.95),
        Finding("largest residual of a post", float(np.max(np.abs(residual))), high=1.0, unit="px"),
        Finding("largest error of a fitted curve over all rows", max(map(float, curve)),
                high=0.6, unit="px"),
        Finding("largest residual over the depth of field: the gate is too weak",
                float(np.max(np.abs(residual))) / least_focus, high=0.1),
        Finding("depth of field in rows against 14.65, 12.97, 15.02 and 14.96, largest difference",
                max(focus), high=0.01, unit="px"),
    ]  # fmt: skip


def _magnification_findings(made: dict[str, Design], measured: dict[str, Posts]) -> list[Finding]:
    findings = []
    for name, posts in measured.items():
        model = made[name].model
        findings += [
            Finding(f"{name}: slope of the magnification times k'",
                    posts.line.slope * model.k_prime_px, 0.985, 1.015),
            Finding(f"{name}: zero of the magnification, distance to row -b'",
                    posts.line.zero_row + model.b_prime_px, -12.0, 12.0, "px"),
        ]  # fmt: skip
    return findings


def _posts_table(made: dict[str, Design], measured: dict[str, Posts]) -> DataTable:
    rows: list[list[float | str]] = []
    for name, posts in measured.items():
        model = made[name].model
        step = model.range_per_row_mm(posts.range_mm)
        focus = made[name].at(posts.range_mm).depth_of_field_mm
        columns = (posts.range_mm, posts.row, posts.fit.residual_px,
                   posts.fit.residual_px * step, step, focus, posts.magnification)  # fmt: skip
        rows += [[name, *map(float, line)] for line in zip(*columns, strict=True)]
    return DataTable(
        [
            "build",
            "range_mm",
            "row_px",
            "residual_px",
            "residual_mm",
            "one_row_mm",
            "depth_of_field_mm",
            "magnification",
        ],
        rows,
        shown=False,
    )


def _fits_table(made: dict[str, Design], measured: dict[str, Posts]) -> DataTable:
    rows: list[list[float | str]] = []
    for name, posts in measured.items():
        model, fit = made[name].model, posts.fit
        sigma = np.sqrt(np.diag(fit.covariance))
        rows.append(
            [
                name,
                model.k_prime_px,
                fit.model.k_prime_px,
                float(sigma[0]),
                1.0 / posts.line.slope,
                model.b_prime_px,
                fit.model.b_prime_px,
                float(sigma[1]),
                -posts.line.zero_row,
            ]
        )
    return DataTable(
        [
            "build",
            "k_prime_px",
            "k_prime_fitted_px",
            "k_prime_sigma_px",
            "k_prime_from_sizes_px",
            "b_prime_px",
            "b_prime_fitted_px",
            "b_prime_sigma_px",
            "b_prime_from_sizes_px",
        ],
        rows,
    )


def _colour(made: dict[str, Design], name: str) -> str:
    return f"C{list(made).index(name)}"


def _curves_figure(made: dict[str, Design], measured: dict[str, Posts]) -> Figure:
    figure = new_figure(8.0, 5.0)
    axes = figure.add_subplot()
    rows = np.arange(720.0)
    for name, build in made.items():
        style = "--" if name == "nominal" else "-"
        axes.plot(rows, build.model.range_mm(rows), style, color=_colour(made, name), label=name)
    for name, posts in measured.items():
        axes.plot(posts.row, posts.range_mm, "o", color=_colour(made, name), markersize=4.5)
    axes.plot([], [], "o", color="0.4", label="posts")
    axes.set(xlabel="row (px)", ylabel="range (mm)", title="Fig. 4A: range over row")
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


def _residuals_figure(made: dict[str, Design], measured: dict[str, Posts]) -> Figure:
    figure = new_figure(11.0, 4.6)
    in_mm, in_rows = figure.subplots(1, 2)
    for name, posts in measured.items():
        colour, build = _colour(made, name), made[name]
        ranges = np.linspace(*build.range_limits_mm, 200)
        step, focus = build.model.range_per_row_mm(ranges), build.at(ranges).depth_of_field_mm
        for sign in (-1.0, 1.0):
            in_mm.plot(ranges, sign * focus, ":", color=colour, linewidth=1.2)
            in_mm.plot(ranges, sign * step, "--", color=colour, linewidth=1.0)
        at_posts = build.model.range_per_row_mm(posts.range_mm)
        in_mm.plot(posts.range_mm, posts.fit.residual_px * at_posts, "o", color=colour, ms=4.5)
        in_rows.plot(posts.range_mm, posts.fit.residual_px, "o", color=colour, ms=4.5, label=name)
    in_mm.plot([], [], ":", color="0.4", label="± depth of field (Eq. 3)")
    in_mm.plot([], [], "--", color="0.4", label="± one row (Eq. 4)")
    in_mm.plot([], [], "o", color="0.4", label="posts")
    in_mm.set_yscale("symlog", linthresh=5.0)
    in_mm.set(xlabel="range (mm)", ylabel="range residual (mm)", title="Fig. 4B: against focus")
    in_mm.legend(loc="upper center", ncols=2, fontsize="small")
    in_mm.set_ylim(-300.0, 1000.0)
    in_mm.set_yticks([-100, -10, -5, 0, 5, 10, 100], ["-100", "-10", "-5", "0", "5", "10", "100"])
    in_rows.axhspan(-3.0 * SIGMA_ROW_PX, 3.0 * SIGMA_ROW_PX, color="0.9", label="± 3 sigma_row")
    in_rows.set(xlabel="range (mm)", ylabel="row residual (px)", title="In rows", ylim=(-1.3, 1.3))
    in_rows.legend(loc="upper center", ncols=2, fontsize="small")
    for axes in (in_mm, in_rows):
        axes.grid(alpha=0.3)
    return figure


def _magnification_figure(made: dict[str, Design], measured: dict[str, Posts]) -> Figure:
    figure = new_figure(8.0, 4.6)
    axes = figure.add_subplot()
    for name, build in made.items():
        rows = np.array([0.0, -build.model.b_prime_px])
        style = "--" if name == "nominal" else "-"
        axes.plot(rows, build.model.magnification(rows), style, color=_colour(made, name),
                  label=name)  # fmt: skip
    for name, posts in measured.items():
        axes.plot(posts.row, posts.magnification, "o", color=_colour(made, name), markersize=4.5)
    axes.plot([], [], "o", color="0.4", label="posts")
    axes.axvspan(719.5, 1200.0, color="0.93", label="off the sensor")
    axes.set(
        xlabel="row (px)",
        ylabel="magnification",
        title="Fig. 4C: magnification over row",
        xlim=(0.0, 1200.0),
        ylim=(0.0, None),
    )
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


EXPERIMENT = Experiment("range_curves", "Fig. 4: range curves, residuals, magnification", run)
