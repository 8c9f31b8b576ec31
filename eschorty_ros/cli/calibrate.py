"""`eschorty calibrate`."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.console import of_total, pairs, progress_bar, show, table, warn
from eschorty_ros.cli.files import OUT_FILE, check_output, is_yaml, report_replaced
from eschorty_ros.cli.instrument import nodes_module
from eschorty_ros.cli.options import Number, refuse_given
from eschorty_ros.core.base.errors import FitError
from eschorty_ros.core.optics import SHIPPED

if TYPE_CHECKING:
    from eschorty_ros.core.calibration import CalibrationReport, KnownTarget, Method, Targets
    from eschorty_ros.core.optics import Calibration

# Targets side by side in a profile of a moving target when roll or smile is fitted.
_BLOCKS = 8
_OF_SOURCES = ("moving", "range_per_stage", "free", "prior", "robust", "row_sigma")


@click.command("calibrate")
@click.argument(
    "sources",
    metavar="[SOURCE]...",
    nargs=-1,
    type=click.Path(exists=True, path_type=Path),
)
@click.option(
    "--nominal",
    default="config_3",
    show_default=True,
    help=f"The build as designed: {', '.join(SHIPPED)}, or a calibration.yaml.",
)
@click.option(
    "--out",
    type=OUT_FILE,
    default=Path("calibration.yaml"),
    show_default=True,
    help="Calibration to write; its page goes beside it as .html.",
)
@click.option(
    "--method",
    type=click.Choice(["joint", "paper"]),
    default="joint",
    show_default=True,
    help="joint: k', b, b', with sizes also k, under priors. paper: k' and b' alone.",
)
@click.option(
    "--distances",
    metavar="FILE|MM,MM,...",
    help="Ranges of the posts of a recording: a CSV file or a list in mm.",
)
@click.option(
    "--moving",
    type=Number(),
    metavar="MM",
    help="One target moved by the stage instead of posts: its range with the stage at 0.",
)
@click.option(
    "--range-per-stage",
    type=Number(-1, 1),
    default=1.0,
    show_default=True,
    help="With --moving: range gained per stage travel, negative towards the sensor.",
)
@click.option(
    "--free",
    multiple=True,
    metavar="NAME",
    help="Fit these parameters only: k_mm, k_prime_px, b_mm, b_prime_px, b_prime_1_px, "
    "b_prime_2_px, width_bias_px. May be given several times.",
)
@click.option(
    "--prior",
    multiple=True,
    metavar="NAME=SIGMA",
    help="Deviation of a parameter from the design, one sigma; none for no prior.",
)
@click.option(
    "--robust/--no-robust",
    default=None,
    help="Find targets that do not follow the curve and leave them out.  "
    "[default: with joint, from 5 targets on]",
)
@click.option(
    "--row-sigma", type=Number(0, min_open=True), default=0.3, show_default=True,
    help="Error of a row, px, where targets.csv gives none.",
)  # fmt: skip
@click.option(
    "--range-sigma", type=Number(0), default=1.0, show_default=True,
    help="Error of a known range, mm, where the file gives none; of --moving it shifts all ranges.",
)  # fmt: skip
@click.option(
    "--fake",
    is_flag=True,
    help="No SOURCE: run all nodes on simulated hardware and calibrate on nine posts.",
)
@click.option(
    "--as-built",
    default="config_3_as_built",
    show_default=True,
    help="With --fake: the build of the simulated world.",
)
def command(
    sources: tuple[Path, ...],
    nominal: str,
    out: Path,
    method: Method,
    distances: str | None,
    moving: float | None,
    range_per_stage: float,
    free: tuple[str, ...],
    prior: tuple[str, ...],
    robust: bool | None,
    row_sigma: float,
    range_sigma: float,
    fake: bool,
    as_built: str,
) -> None:
    """Calibrate a build on targets at known ranges.

    SOURCE is a CSV file of targets, a recording folder or, of posts, its events.raw alone; several
    count together. Writes a calibration.yaml for --calibration of scan, simulate, reconstruct and
    convert, and a page with its uncertainty and verdicts. Where targets are refused nothing is
    written, and an existing file stays.

    \b
    targets.csv   row,range_mm[,row_sigma][,range_sigma_mm][,column]
                  [,width_px,size_mm][,spacing_px,spacing_mm][,shared_sigma_mm][,label]
      row         row of the target, px; row_sigma its error
      range_mm    range along the laser sheet from the mechanical datum
      width_px    columns a target of size_mm covers; two sizes or more, because light blooms
      spacing_px  columns between the centres of two marks spacing_mm apart

    \b
    A recording   --distances: posts at these ranges, at least two, sizes helpful; a CSV file
                  has range_mm[,range_sigma_mm][,size_mm][,column][,row][,label]
                  --moving: a flat target that the stage moves along the range; give sweeps
                back and forth, because a moving line is measured late

    \b
    Verdicts
      identifiable        the targets determine every fitted parameter, and
                          nothing speaks against the fit
      prior dominates X   X comes from the design; add targets or spread them
      extrapolates ...    ranges outside of what the targets cover are not backed by them

    \b
    Examples:
      eschorty calibrate targets.csv --nominal config_3 --out calibration.yaml
      eschorty calibrate targets.csv --method paper
      eschorty calibrate rec --distances 820,960,1110,1270,1440,1610,1770,1910,2050
      eschorty calibrate rec --distances posts.csv --prior b_mm=1
      eschorty calibrate forth back --moving 780
      eschorty calibrate forth back --moving 780 --free k_prime_px --free b_prime_px \\
                         --free b_prime_1_px --free b_prime_2_px
      eschorty calibrate --fake

    \b
    Exit codes:
      0  written; read the verdicts
      1  the targets do not determine the build, or a file is at fault
      2  wrong usage
    """  # noqa: D301
    if fake:
        if sources:
            raise click.UsageError("--fake takes no SOURCE")
        refuse_given(_OF_SOURCES, "is for a SOURCE; --fake takes none")
        if distances is None:
            refuse_given(["range_sigma"], "belongs to --distances")
        _check_out(out)
        _calibrate_simulated(_known(distances, range_sigma), nominal, as_built, method, out)
        return
    _check_sources(sources, distances, moving)
    _check_out(out)
    priors = _priors(prior)
    from eschorty_ros.core.calibration import (
        COLUMN_TERMS,
        Targets,
        calibrate,
        read_targets,
        recorded_moving_target,
    )
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.core.storage import load_recording

    design = load_calibration(nominal)
    # Roll and smile need several targets side by side.
    blocks = _BLOCKS if set(COLUMN_TERMS) & set(free) else 1
    swept: set[bool] = set()

    def targets_of(source: Path) -> Targets:
        if not _is_recorded(source):
            return read_targets(source, sigma_row_px=row_sigma, sigma_range_mm=range_sigma)
        if moving is None:
            return _posts(source, design, distances, range_sigma)
        _warn_of_another_build(source, design)
        recording = load_recording(source, design)
        stage_mm = recording.stage_samples["position_mm"]
        to_and_fro = 2.0 * abs(stage_mm[-1] - stage_mm[0]) < stage_mm.max() - stage_mm.min()
        swept.update((True, False) if to_and_fro else (bool(stage_mm[-1] > stage_mm[0]),))
        with progress_bar("reading") as report:
            return recorded_moving_target(
                recording, design, moving, range_per_stage=range_per_stage,
                sigma_at_zero_mm=range_sigma, blocks=blocks, progress=of_total(report),
            )  # fmt: skip

    targets = Targets.concatenate([targets_of(source) for source in sources])
    if len(swept) == 1:
        warn(
            "the stage moves in one direction only, and a moving line is measured late; give a "
            "sweep of the other direction, too"
        )
    report = calibrate(
        targets,
        design,
        method,
        free=free or None,
        prior_sigma=priors,
        robust=robust,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
    )
    _finish(report, {"targets from": ", ".join(map(str, sources)), "design": nominal}, out)


def _check_sources(sources: tuple[Path, ...], distances: str | None, moving: float | None) -> None:
    """Refuse options that have no effect on these sources, or are missing, as wrong usage."""
    refuse_given(["as_built"], "belongs to --fake")
    if all(map(_is_recorded, sources)):
        refuse_given(["row_sigma"], "is for a targets.csv")
    if moving is None:
        refuse_given(["range_per_stage"], "belongs to --moving")
    if not sources:
        raise click.UsageError("no SOURCE; give targets.csv, a recording, or --fake")
    recorded = [source for source in sources if _is_recorded(source)]
    if not recorded and (distances is not None or moving is not None):
        raise click.UsageError("--distances and --moving belong to a recording")
    if recorded and (distances is None) == (moving is None):
        raise click.UsageError(f"{recorded[0]} is a recording; give --distances or --moving")
    alone = [source for source in recorded if not source.is_dir()]
    if alone and moving is not None:
        raise click.UsageError(f"{alone[0]} has no stage; give --moving a recording folder")


def _is_recorded(source: Path) -> bool:
    return source.is_dir() or source.suffix.lower() == ".raw"


def _check_out(out: Path) -> None:
    if not is_yaml(out):
        raise click.UsageError(f"--out is {out}; give a path ending in .yaml")
    check_output(out)


def _priors(given: tuple[str, ...]) -> dict[str, float] | None:
    """Return NAME=SIGMA as a mapping; ``none`` becomes infinity."""
    priors = {}
    for text in given:
        name, equals, value = text.partition("=")
        try:
            priors[name] = math.inf if value == "none" else float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise click.UsageError(f"--prior is {text!r}; write NAME=SIGMA, such as b_mm=3")
    return priors or None


def _warn_of_another_build(source: Path, design: Calibration) -> None:
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.core.storage.recording import CALIBRATION_FILE

    if not (source / CALIBRATION_FILE).is_file():
        return
    made = load_calibration(source / CALIBRATION_FILE)
    if made.name != design.name:
        warn(
            f"{source} is of the build {made.name} and --nominal of {design.name}; give the "
            "design that made it"
        )


def _posts(source: Path, design: Calibration, distances: str | None, range_sigma: float) -> Targets:
    """Return the posts that are found in events; print which are left out."""
    from eschorty_ros.core.calibration import recorded_posts
    from eschorty_ros.core.storage.recording import recorded_events

    known = _known(distances, range_sigma)
    events = recorded_events(source) if source.is_dir() else source
    _warn_of_another_build(source, design)
    with progress_bar("reading") as report:
        match = recorded_posts(events, known, design, of_total(report))
    for line in match.rejected:
        click.echo(f"left out: {line}")
    if match.targets is None:
        near_mm, far_mm = design.model().range_limits_mm
        remedy = f"give millimetres, {near_mm:.0f} to {far_mm:.0f} with this --nominal"
        if any(near_mm <= target.range_mm <= far_mm for target in known):
            remedy = "check them, and --nominal"
        raise FitError(f"--distances is {distances}; no post is there; {remedy}")
    return match.targets


def _known(distances: str | None, range_sigma: float) -> list[KnownTarget]:
    """Read the posts' ranges: a list in mm, a CSV file, or those of the simulated scene."""
    from eschorty_ros.core.calibration import KnownTarget, read_distances
    from eschorty_ros.core.optics import config_file

    if distances is None:
        return read_distances(config_file("posts.csv"))
    try:
        ranges = [float(part) for part in distances.rstrip(", ").split(",")]
    except ValueError:
        if ("," in distances or ";" in distances) and not Path(distances).exists():
            raise click.UsageError(
                f"--distances is {distances}; give millimetres between commas, or a CSV file"
            ) from None
        return read_distances(distances, sigma_range_mm=range_sigma)
    if len(ranges) < 2:
        raise click.UsageError(f"--distances is {distances}; give two or more, between commas")
    return [KnownTarget(range_mm, range_sigma) for range_mm in ranges]


def _finish(report: CalibrationReport, made_with: Mapping[str, str], out: Path) -> None:
    """Write the calibration and its page; print parameters, rejected targets and verdicts."""
    from eschorty_ros.core.base.files import atomic_write
    from eschorty_ros.core.optics import save_calibration
    from eschorty_ros.report.calibration_page import calibration_html

    page = calibration_html(report, made_with)
    report_replaced(out, out.with_suffix(".html"))
    # Last, so that an old one stays where the page has no room.
    with atomic_write(out.with_suffix(".html")) as stream:
        stream.write(page.encode())
    save_calibration(report.calibration, out)
    _show(report)
    click.echo(str(out))
    click.echo(str(out.with_suffix(".html")))


def _show(report: CalibrationReport) -> None:
    from eschorty_ros.report.calibration_page import parameters
    from eschorty_ros.report.page import number

    used = int(report.used.sum())
    made = table(
        f"{report.calibration.id}: {used} of {len(report.targets)} targets, residual "
        f"{number(report.calibration.residual_rms_px or 0.0)} px, reduced chi-square "
        f"{number(report.fit.reduced_chi_square)}",
        *("", "value", "sigma", "design", "prior sigma"),
    )
    for entry in parameters(report):
        sigma = "fixed" if math.isnan(entry.sigma) else number(entry.sigma)
        prior = "" if math.isnan(entry.prior) else number(entry.prior)
        made.add_row(entry.name, number(entry.value), sigma, number(entry.nominal), prior)
    show(made)
    for left_out in report.rejected:
        click.echo(f"rejected: {left_out.label}: {left_out.reason}")
    known = "identifiable" if report.identifiable else "not identifiable"
    plural = "" if len(report.reservations) == 1 else "s"
    click.echo(f"verdict: {known}, {len(report.reservations)} reservation{plural}")
    for line in report.reservations:
        click.echo(f"verdict: {line}")


def _calibrate_simulated(
    known: list[KnownTarget], nominal: str, as_built: str, method: Method, out: Path
) -> None:
    """Run all nodes on an emulated bench that is built ``as_built``, and calibrate there.

    Writes the calibration with its page, and the sum of all events as a picture; prints the range
    errors of the design and of the calibration.
    """
    one_calibration = nodes_module("one_process.calibration", make="setup")
    from matplotlib.image import imsave

    from eschorty_ros.core.base.files import atomic_write, temporary_folder
    from eschorty_ros.core.calibration import calibrate
    from eschorty_ros.core.optics import load_calibration

    design, built = load_calibration(nominal), load_calibration(as_built)
    with temporary_folder() as folder:
        job = one_calibration.CalibrationJob(
            tuple(known), str(folder), calibration=nominal, as_built=as_built, method=method
        )
        with progress_bar("calibrating") as feedback:
            outcome = one_calibration.calibrate_once(job, feedback)
    if outcome.calibration is None or outcome.targets is None:
        raise FitError(outcome.message)
    report = calibrate(outcome.targets, design, method, date=outcome.calibration.date)
    _finish(report, {"targets from": f"{len(known)} simulated posts", "design": nominal}, out)
    shown = {f"target {entry.label}: {entry.reason}" for entry in report.rejected}
    for line in outcome.rejected:
        if line not in shown:
            click.echo(f"rejected: {line}")
    picture = out.with_suffix(".png")
    with atomic_write(picture) as stream:
        imsave(stream, outcome.frame, format="png", cmap="gray", vmin=0, vmax=255)
    _print_errors(picture, design, report.calibration, built)


def _print_errors(
    picture: Path, design: Calibration, made: Calibration, built: Calibration
) -> None:
    import numpy as np

    true_mm = np.linspace(800.0, 2100.0, 131)
    true_row = built.model().row(true_mm)

    def rms_mm(calibration: Calibration) -> str:
        error = calibration.model().range_mm(true_row) - true_mm
        return f"{float(np.sqrt(np.mean(error**2))):.2f} mm"

    pairs(
        str(picture),
        {
            "range RMS 0.8-2.1 m, as designed": rms_mm(design),
            "range RMS 0.8-2.1 m, calibrated": rms_mm(made),
        },
    )
