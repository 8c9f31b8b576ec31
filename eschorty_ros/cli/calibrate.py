"""`eschorty calibrate`."""

from __future__ import annotations

import datetime
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.calibration_sources import known, recorded

if TYPE_CHECKING:
    from eschorty_ros.core.calibration import Method

BLOCKS = 8
"""Targets side by side that a moving target gives when the fit asks for roll or smile."""


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
    help="The build as designed: nominal, config_1, config_2, config_3, or a calibration.yaml.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
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
    type=float,
    metavar="MM",
    help="One target moved by the stage instead of posts: its range with the stage at 0.",
)
@click.option(
    "--range-per-stage",
    type=click.FloatRange(-1, 1),
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
    help="How far a parameter may lie from the design, one sigma; none for no prior.",
)
@click.option(
    "--robust/--no-robust",
    default=None,
    help="Find targets that do not follow the curve and leave them out.  "
    "[default: with joint, from 5 targets on]",
)
@click.option(
    "--row-sigma", type=click.FloatRange(0, min_open=True), default=0.3, show_default=True,
    help="Error of a row, px, where targets.csv gives none.",
)  # fmt: skip
@click.option(
    "--range-sigma", type=click.FloatRange(0), default=1.0, show_default=True,
    help="Error of a known range, mm, where the file gives none.",
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
    help="With --fake: the build that the simulated world really has.",
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

    SOURCE is a CSV file of targets or a recording folder; several count together. Writes a
    calibration.yaml for --calibration of the other commands, and a page that shows how far to
    trust it. When the targets do not determine the build nothing is written, and an existing
    file stays.

    \b
    targets.csv   row,range_mm[,row_sigma][,range_sigma_mm][,column]
                  [,width_px,size_mm][,spacing_px,spacing_mm][,label]
      row         where the target appears, px; row_sigma its error
      range_mm    range along the laser sheet from the mechanical datum
      width_px    columns a target of size_mm covers; two sizes or more, because light blooms
      spacing_px  columns between the centres of two marks spacing_mm apart

    \b
    A recording   --distances: posts at these ranges, at least two, sizes helpful; a CSV file
                  has range_mm[,range_sigma_mm][,size_mm][,column][,row][,label]
                  --moving: a flat target that the stage moves along the range; give sweeps
                forth and back, because a moving line is seen late

    \b
    Verdicts
      identifiable        the targets determine every fitted parameter
      prior dominates X   X comes from the design: more targets, or another spread, tell it
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
        if sources or moving is not None or free or prior or robust is not None:
            raise click.UsageError("--fake takes no SOURCE, --moving, --free, --prior or --robust")
        _check_out(out)
        from eschorty_ros.cli.calibrate_simulated import calibrate_simulated

        calibrate_simulated(known(distances, range_sigma), nominal, as_built, method, out)
        return
    _check_usage(sources, out, distances, moving)
    priors = _priors(prior)
    from eschorty_ros.cli.calibration_output import finish
    from eschorty_ros.core.calibration import COLUMN_TERMS, Targets, calibrate, read_targets
    from eschorty_ros.core.optics import load_calibration

    design = load_calibration(nominal)
    made_with = {"targets from": ", ".join(map(str, sources)), "design": nominal}
    # What varies across the columns shows in several targets side by side.
    blocks = BLOCKS if set(COLUMN_TERMS) & set(free) else 1
    targets = Targets.concatenate(
        [
            recorded(source, design, distances, moving, range_per_stage, range_sigma, blocks)
            if source.is_dir()
            else read_targets(source, sigma_row_px=row_sigma, sigma_range_mm=range_sigma)
            for source in sources
        ]
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
    finish(report, made_with, out)


def _check_usage(
    sources: tuple[Path, ...], out: Path, distances: str | None, moving: float | None
) -> None:
    _check_out(out)
    if not sources:
        raise click.UsageError("no SOURCE; give targets.csv, a recording, or --fake")
    folders = [source for source in sources if source.is_dir()]
    if not folders and (distances is not None or moving is not None):
        raise click.UsageError("--distances and --moving belong to a recording folder")
    if folders and (distances is None) == (moving is None):
        raise click.UsageError(f"{folders[0]} is a recording; give --distances or --moving")


def _check_out(out: Path) -> None:
    from eschorty_ros.core.base.files import check_writable

    if out.suffix not in (".yaml", ".yml"):
        raise click.UsageError(f"--out is {out}; give a path ending in .yaml")
    check_writable(out)


def _priors(given: tuple[str, ...]) -> dict[str, float] | None:
    """NAME=SIGMA as a mapping; ``none`` becomes infinity."""
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
