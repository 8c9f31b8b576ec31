"""`eschorty register`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eschorty_ros.cli.console import progress_bar, show, table, warn
from eschorty_ros.cli.files import IN_FILE, OUT_FILE, check_output, json_option, report_replaced
from eschorty_ros.cli.options import Number

if TYPE_CHECKING:
    from eschorty_ros.surfaces.register import Pose


@click.command("register")
@click.argument("clouds", nargs=-1, required=True, type=IN_FILE)
@click.option(
    "--start",
    "starts",
    multiple=True,
    nargs=6,
    type=Number(),
    metavar="X Y Z RX RY RZ",
    help="First guess for the next cloud: shift in mm, rotation vector in degrees.  [default: 0]",
)
@click.option(
    "--reach-mm",
    type=Number(0.0, min_open=True),
    default=10.0,
    show_default=True,
    help="Farthest partner of a point in the first round; halved three times.",
)
@click.option(
    "--out",
    type=OUT_FILE,
    default=Path("registered.pcd"),
    show_default=True,
    help="Joined cloud, .pcd or .ply; beside it a picture, .png.",
)
@json_option
def command(
    clouds: tuple[Path, ...],
    starts: tuple[tuple[float, ...], ...],
    reach_mm: float,
    out: Path,
    as_json: bool,
) -> None:
    """Bring CLOUDS (.pcd or .ply of this package) into the frame of the first; needs open3d.

    Each is registered against those before it by ICP with the points' own sigmas as weights.
    Printed are its rotation, its shift at the middle of the overlap, both with sigma, the distance
    of its points from the others in sigmas (0.5 to 1 where they fit), and with --json the transform
    in m and the covariance. --start turns about the sensor, not about the part, and then shifts:
    15 degrees move a part at 1.3 m by 340 mm.

    \b
    Examples:
      eschorty register forth.pcd back.pcd
      eschorty register front.pcd side.pcd --start 0 30 0 0 0 15 --out both.ply
    """  # noqa: D301
    from eschorty_ros.core.base.errors import ArgumentError
    from eschorty_ros.core.storage import is_cloud, read_cloud, write_cloud
    from eschorty_ros.report import figures
    from eschorty_ros.report.surface_figures import joined_figure
    from eschorty_ros.surfaces.register import (
        GOOD_SIGMAS,
        POOR_SIGMAS,
        join,
        pose_matrix,
        register,
    )

    if len(clouds) < 2 or len(starts) > len(clouds) - 1:
        raise click.UsageError("give two clouds or more, and at most one --start for each further")
    if not is_cloud(out):
        raise ArgumentError(f"{out} ends in {out.suffix!r}; choose .pcd or .ply")
    check_output(out, *clouds)
    parts = [read_cloud(path) for path in clouds]
    joined, poses, sizes = parts[0], [], [len(parts[0])]
    with progress_bar("registering") as report:
        for number, part in enumerate(parts[1:]):

            def progress(share: float, _: str, number: int = number) -> None:
                report((number + share) / (len(parts) - 1), clouds[number + 1].name)

            start = pose_matrix(starts[number]) if number < len(starts) else None
            try:
                pose = register(joined, part, start, reach_mm, progress)
            except ArgumentError as error:
                onto = ", ".join(str(path) for path in clouds[: number + 1])
                raise ArgumentError(f"{clouds[number + 1]} onto {onto}: {error}") from error
            if pose.rms_sigmas < GOOD_SIGMAS:
                warn(
                    f"{clouds[number + 1]}: its points are {pose.rms_sigmas:.2f} sigma (RMS) from "
                    "the clouds before, where 0.5 to 1 is right; check that it is another scan, "
                    "and that sigmas are not too large"
                )
            if pose.rms_sigmas > POOR_SIGMAS:
                warn(
                    f"{clouds[number + 1]}: its points are {pose.rms_sigmas:.1f} sigma (RMS) from "
                    "the clouds before, where 0.5 to 1 is right; check the picture, the start and "
                    "that nothing moved"
                )
            joined = join(joined, part, pose)
            poses.append(pose)
            sizes.append(len(part))
    picture = out.with_suffix(".png")
    report_replaced(out, picture)
    write_cloud(out, joined)
    figures.save(joined_figure(joined, sizes, str(out)), picture)
    if as_json:
        facts = [_facts(path, pose) for path, pose in zip(clouds[1:], poses, strict=True)]
        click.echo(json.dumps({"cloud": str(out), "points": len(joined), "poses": facts}))
    else:
        _print(clouds[1:], poses, f"{out}, {picture}: {len(joined):,} points")


def _facts(path: Path, pose: Pose) -> dict[str, Any]:
    return {
        "cloud": str(path),
        "transform_m": pose.transform.tolist(),
        "rotation_deg": pose.rotation_deg.tolist(),
        "shift_mm": pose.shift_mm.tolist(),
        "sigma_deg_mm": pose.sigmas.tolist(),
        "covariance_rad_mm": pose.covariance.tolist(),
        "centre_mm": pose.centre_mm.tolist(),
        "pairs": pose.pairs,
        "overlap": pose.overlap,
        "rms_sigmas": pose.rms_sigmas,
    }


def _print(clouds: tuple[Path, ...], poses: list[Pose], title: str) -> None:
    rows = table(title, "cloud", "", "x", "y", "z", "pairs", "overlap")
    for path, pose in zip(clouds, poses, strict=True):
        sigmas = pose.sigmas
        texts = [
            [f"{value:.3f} ± {sigma:.3f}" for value, sigma in zip(values, spread, strict=True)]
            for values, spread in ((pose.rotation_deg, sigmas[:3]), (pose.shift_mm, sigmas[3:]))
        ]
        rows.add_row(path.name, "turn °", *texts[0], f"{pose.pairs:,}", f"{pose.overlap:.1%}")
        rows.add_row("", "shift mm", *texts[1], "rms/sigma", f"{pose.rms_sigmas:.2f}")
    show(rows)
