"""`eschorty measure`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eschorty_ros.cli.console import show, table, warn
from eschorty_ros.cli.files import IN_FILE, OUT_FILE, check_picture, json_option, report_replaced
from eschorty_ros.cli.options import Number
from eschorty_ros.surfaces.plane import COMMON_SHARE

if TYPE_CHECKING:
    from eschorty_ros.surfaces.measure import Measured, Surface
    from eschorty_ros.surfaces.plane import Value


@click.command("measure")
@click.argument("cloud", type=IN_FILE)
@click.option(
    "--region",
    "regions",
    multiple=True,
    metavar="COLUMNS,SWEEP",
    help="Columns in px and sweep position y in mm, such as 100:400,20:60; an end may be left "
    "out. Again for further surfaces.  [default: the surfaces between steps of the range]",
)
@click.option(
    "--common-mm",
    type=Number(0.0),
    help="Sigma of a range error that all points of one surface share.  [default: "
    f"{COMMON_SHARE:g} of the points' own sigma]",
)
@json_option
@click.option(
    "--out",
    type=OUT_FILE,
    help="Also draw the surfaces and their residuals here, .png, .pdf or .svg.",
)
def command(
    cloud: Path,
    regions: tuple[str, ...],
    common_mm: float | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """Measure planes in CLOUD (.pcd or .ply of this package), every value with its sigma.

    Each surface gets a plane: range at its middle, slopes, and flatness (peak to valley of up to
    8 by 8 cells; a perfect plane shows some at this noise, too). Sigmas hold the scatter,
    correlations and a common error, not the calibration's. Every further surface is measured
    against the first one: distance (of two parallel planes), angle, flush (step where the two face
    each other) and gap (space between the facing edges; along the sweep the laser line's thickness
    shifts an edge by up to half of it).

    \b
    Examples:
      eschorty measure scan/scan.pcd
      eschorty measure scan/scan.pcd --region 20:140,:30 --region 180:300,:30 --out step.png
      eschorty measure rec/cloud.pcd --json
    """  # noqa: D301
    from eschorty_ros.core.storage import read_cloud
    from eschorty_ros.surfaces.measure import faults, measure, parse_region

    chosen = tuple(parse_region(text) for text in regions)
    if out is not None:
        check_picture(out, cloud)
    points = read_cloud(cloud)
    measured = measure(points, chosen, common_mm)
    if as_json:
        click.echo(json.dumps(_finite(_facts(measured))))
    else:
        _print(measured, cloud.name)
        unused = len(points) - int(measured.grid.known.sum())
        if unused:
            click.echo(
                f"{unused:,} of {len(points):,} points are not used: they are flagged mixed or "
                "sensor_edge, have no place, time or sigma, or share a column and period"
            )
    for line in faults(measured):
        warn(line)
    if out is not None:
        from eschorty_ros.report import figures
        from eschorty_ros.report.surface_figures import measured_figure

        report_replaced(out)
        figures.save(measured_figure(points, measured, cloud.name), out)
        click.echo(str(out), err=as_json)


def _facts(measured: Measured) -> dict[str, Any]:
    surfaces = [
        {
            "points": len(surface.part.line),
            "left_out": int((~surface.plane.kept).sum()),
            "columns": _columns(surface, measured.grid.first_column),
            "range_mm": surface.range_mm._asdict(),
            "slope_sweep": surface.plane.slope(0)._asdict(),
            "slope_column": surface.plane.slope(1)._asdict(),
            "rms_mm": surface.plane.rms_mm,
            "flatness_mm": surface.flat.value_mm._asdict(),
            "flatness_of_plane_mm": surface.flat.of_plane_mm,
        }
        for surface in measured.surfaces
    ]
    pairs = [
        {"surface": number, **{name: value._asdict() for name, value in pair._asdict().items()}}
        for number, pair in enumerate(measured.pairs, 2)
    ]
    return {"surfaces": surfaces, "pairs": pairs}


def _finite(value: Any) -> Any:
    """Return what JSON can hold: null instead of a number that is unknown."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _columns(surface: Surface, first: int) -> list[int]:
    """Return the first and the last column of a surface on a grid that begins at ``first``."""
    numbers = surface.part.column
    return [int(numbers.min()) + first, int(numbers.max()) + first]


def _text(value: Value) -> str:
    """Return a value and its sigma, one or two digits of the latter."""
    if not math.isfinite(value.value + value.sigma):
        return "-"
    places = max(math.ceil(-math.log10(value.sigma / 2.0)), 0) if value.sigma > 0.0 else 3
    return f"{value.value:.{places}f} ± {value.sigma:.{places}f}"


def _print(measured: Measured, title: str) -> None:
    first = table(
        title, "surface", "points", "left out", "range mm", "slope y", "slope z", "rms mm",
        "flatness mm", "if perfect",
    )  # fmt: skip
    for number, surface in enumerate(measured.surfaces, 1):
        plane, flat = surface.plane, surface.flat
        first.add_row(
            str(number), f"{len(surface.part.line):,}", f"{int((~plane.kept).sum()):,}",
            _text(surface.range_mm), _text(plane.slope(0)), _text(plane.slope(1)),
            f"{plane.rms_mm:.2f}", _text(flat.value_mm),
            f"{flat.of_plane_mm:.2f}" if math.isfinite(flat.of_plane_mm) else "-",
        )  # fmt: skip
    show(first)
    if measured.pairs:
        second = table("", "to surface 1", "distance mm", "angle °", "flush mm", "gap mm")
        for number, pair in enumerate(measured.pairs, 2):
            second.add_row(str(number), *(_text(value) for value in pair))
        show(second)
