"""`eschorty view`."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("view")
@click.argument("cloud", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Picture to write, .png, .pdf or .svg.  [default: CLOUD with .png]",
)
@click.option("--window", is_flag=True, help="Open an Open3D window instead (needs open3d).")
def command(cloud: Path, out: Path | None, window: bool) -> None:
    """Draw CLOUD (.pcd or .ply): depth map over column and stage position, and a 3-D view.

    \b
    Examples:
      eschorty view scan/scan.pcd
      eschorty view scan/scan.pcd --out depth.pdf
      eschorty view scan/scan.pcd --window
    """  # noqa: D301
    from eschorty_ros.core.storage import read_cloud

    points = read_cloud(cloud)
    if window:
        _open_window(points, cloud.name)
        return
    from eschorty_ros.report import figures

    target = out or cloud.with_suffix(".png")
    figures.save(figures.scan_figure(points, title=f"{cloud.name}: {len(points):,} points"), target)
    click.echo(str(target))


def _open_window(points: object, title: str) -> None:
    import numpy as np

    from eschorty_ros.simulation.scenes import load_open3d

    open3d = load_open3d("--window")
    xyz = np.column_stack([points[axis] for axis in "xyz"]).astype(np.float64)  # type: ignore[index]
    shape = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz))
    open3d.visualization.draw_geometries([shape], window_name=title)
