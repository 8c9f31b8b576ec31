"""What every way to calibrate leaves behind: the file, its page, and what is printed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import click

from eschorty_ros.cli.console import show, table
from eschorty_ros.core.base.files import atomic_write
from eschorty_ros.core.calibration import CalibrationReport
from eschorty_ros.core.optics import save_calibration
from eschorty_ros.report.calibration_page import calibration_html, parameters
from eschorty_ros.report.page import number


def finish(report: CalibrationReport, made_with: Mapping[str, str], out: Path) -> None:
    """Write the calibration and its page, print parameters, what was left out, and verdicts.

    Parameters
    ----------
    report : CalibrationReport
    made_with : mapping of str to str
        Facts for the page: where the targets came from.
    out : path
        Calibration to write; the page goes beside it as .html.

    Raises
    ------
    ArgumentError
        When a file cannot be written.
    """
    page = calibration_html(report, made_with)
    save_calibration(report.calibration, out)
    with atomic_write(out.with_suffix(".html")) as stream:
        stream.write(page.encode())
    _show(report)
    click.echo(str(out))
    click.echo(str(out.with_suffix(".html")))


def _show(report: CalibrationReport) -> None:
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
    for line in report.verdicts:
        click.echo(f"verdict: {line}")
