"""`eschorty report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.console import progress_bar, show, table
from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.base.files import make_folder

if TYPE_CHECKING:
    from eschorty_ros.report.sections import Section

try:
    from eschorty_experiments import NAMES
except ModuleNotFoundError:
    NAMES = ()


@click.command("report")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("report"),
    show_default=True,
    help="Folder for the page and its files; files of an earlier report are overwritten.",
)
@click.option(
    "--only",
    type=click.Choice(NAMES),
    multiple=True,
    metavar="NAME",
    help=f"Run this experiment alone; may be given several times. {', '.join(NAMES)}.",
)
@click.option("--fast", is_flag=True, help="A coarse run of the same code, under 2 minutes.")
@click.option(
    "--seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of all noise."
)
def command(out: Path, only: tuple[str, ...], fast: bool, seed: int) -> None:
    """Rerun the experiments and write a page of figures, tables and findings.

    Opens in any browser: DIR/index.html, with a PNG per figure and a CSV per table beside it.
    Each finding is a number with the band it must be in. Needs no ROS.

    The page is written again after every experiment, so one that is interrupted (Ctrl-C) keeps
    what is done. When an experiment fails the others still run; the page shows where it failed.

    \b
    Examples:
      eschorty report
      eschorty report --fast --out quick
      eschorty report --only tables --only range_curves

    \b
    Exit codes:
      0  the report is complete; findings outside their band are listed, they are results
      1  an experiment failed, or the folder cannot be written
      2  wrong usage, such as an unknown NAME
    """  # noqa: D301
    if not NAMES:
        raise EschortyError(
            "the experiments are not installed; run `pip install . ./experiments` in the source "
            "folder of eschorty_ros"
        )
    from eschorty_experiments import load

    from eschorty_ros.report.experiment import Effort
    from eschorty_ros.report.page import write_page
    from eschorty_ros.report.provenance import provenance
    from eschorty_ros.report.sections import run_sections

    names = [name for name in NAMES if name in only] if only else list(NAMES)
    effort = Effort(fast=fast, seed=seed)
    made_with = provenance(effort)
    make_folder(out)
    page = write_page(out, [], made_with, len(names))
    sections: list[Section] = []
    with progress_bar("report") as progress:
        for section in run_sections(names, load, effort, out, progress):
            sections.append(section)
            page = write_page(out, sections, made_with, len(names) - len(sections))
    _summarise(sections)
    click.echo(str(page))
    failed = [section for section in sections if section.failure]
    if failed:
        raise EschortyError(
            f"{len(failed)} of {len(sections)} experiments failed, "
            f"{failed[0].name} with {failed[0].failure}; see {page}"
        )


def _summarise(sections: list[Section]) -> None:
    """Print findings and time of every experiment, then each finding outside its band."""
    from eschorty_ros.report.page import band, reading

    made = table("", "experiment", "findings that hold", "s")
    for section in sections:
        held = len(section.findings) - len(section.missed)
        verdict = "failed" if section.failure else f"{held} of {len(section.findings)}"
        made.add_row(section.name, verdict, f"{section.seconds:.1f}")
    show(made)
    for section in sections:
        for finding in section.missed:
            click.echo(
                f"missed: {section.name}: {finding.name} is {reading(finding)}, "
                f"band {band(finding)}"
            )
