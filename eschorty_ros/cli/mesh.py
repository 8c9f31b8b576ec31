"""`eschorty mesh`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.console import progress_bar, show, table
from eschorty_ros.cli.files import IN_FILE, OUT_FILE, check_output, json_option, report_replaced
from eschorty_ros.cli.options import Number

if TYPE_CHECKING:
    from eschorty_ros.surfaces.mesh import Mesh


@click.command("mesh")
@click.argument("cloud", type=IN_FILE)
@click.option(
    "--sigmas",
    type=Number(0.0, min_open=True),
    default=2.0,
    show_default=True,
    help="95 % of the points are within this multiple of their own sigma from the mesh.",
)
@click.option(
    "--out",
    type=OUT_FILE,
    help="Mesh to write, .ply, .obj or .stl, in m; beside it a picture, .png.  "
    "[default: CLOUD with _mesh.ply]",
)
@json_option
def command(cloud: Path, sigmas: float, out: Path | None, as_json: bool) -> None:
    """Make a triangle mesh of CLOUD (.pcd or .ply of this package); needs open3d.

    Neighbouring periods and columns become triangles, none across a step of the range. The mesh
    is decimated as far as the points' own errors allow; the table shows vertices against error, and
    the largest group of neighbouring points whose relief a coarser mesh loses (fewer than 30).

    \b
    Examples:
      eschorty mesh scan/scan.pcd
      eschorty mesh scan/scan.pcd --sigmas 1.9 --out part.stl
    """  # noqa: D301
    from eschorty_ros.core.storage import read_cloud
    from eschorty_ros.report import figures
    from eschorty_ros.report.surface_figures import mesh_figure
    from eschorty_ros.surfaces.mesh import check_format, mesh, write_mesh

    target = out or cloud.with_name(f"{cloud.stem}_mesh.ply")
    check_format(target)
    check_output(target, cloud)
    with progress_bar("meshing") as report:
        made = mesh(read_cloud(cloud), sigmas, report)
    picture = target.with_suffix(".png")
    report_replaced(target, picture)
    write_mesh(target, made)
    figures.save(mesh_figure(made, sigmas, cloud.name), picture)
    if as_json:
        levels = [level._asdict() for level in made.levels]
        facts = {"mesh": str(target), "points": made.points, "chosen": made.chosen}
        click.echo(json.dumps({**facts, "levels": levels}))
    else:
        _print(made, f"{target}, {picture}: {len(made.vertices):,} of {made.points:,} points")


def _print(made: Mesh, title: str) -> None:
    rows = table(
        title, "vertices", "kept", "triangles", "95 % within mm", "within sigmas", "lost", "",
    )  # fmt: skip
    for number, level in enumerate(made.levels):
        rows.add_row(
            f"{level.vertices:,}", f"{level.vertices / made.points:.2%}", f"{level.triangles:,}",
            f"{level.error_mm:.3f}", f"{level.error_sigmas:.2f}",
            f"{level.lost:,}", "written" if number == made.chosen else "",
        )  # fmt: skip
    show(rows)
