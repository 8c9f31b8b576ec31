"""`eschorty view`."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.console import progress_bar, warn
from eschorty_ros.cli.files import IN_FILE, OUT_FILE, check_output, check_picture, report_replaced
from eschorty_ros.cli.instrument import nodes_module
from eschorty_ros.cli.options import page_options, refuse_given
from eschorty_ros.core.base.errors import DeviceError, FormatError, OtherFormatError

if TYPE_CHECKING:
    from eschorty_ros.core.storage import Points

_BOUNDS = {"x": 1e6, "y": 1e6, "z": 1e6, "t": 1e9}
"""Metres and seconds that a picture can hold."""
_SHOW_S = 0.3


@click.command("view")
@click.argument("cloud", required=False, type=IN_FILE)
@click.option(
    "--out",
    type=OUT_FILE,
    help="Picture to write, .png, .pdf or .svg; .gif shows the scan growing.  "
    "[default: CLOUD with .png]",
)
@click.option("--window", is_flag=True, help="Open an Open3D window instead (needs open3d).")
@click.option("--browser", is_flag=True, help="Serve a page with CLOUD instead (needs viser).")
@click.option(
    "--live",
    is_flag=True,
    help="Serve a page with the instrument of this ROS domain instead of CLOUD (needs viser).",
)
@click.option(
    "--allow-scan",
    is_flag=True,
    help="With --live: the page may start scans, which switch the laser on.",
)
@page_options
def command(
    cloud: Path | None,
    out: Path | None,
    window: bool,
    browser: bool,
    live: bool,
    allow_scan: bool,
    host: str,
    port: int,
) -> None:
    """Draw CLOUD (.pcd or .ply): depth map along the line and the stage, and a 3-D view.

    A cloud of another program needs x, y and z, in metres, and open3d to read it; drawn are a
    view along x and a 3-D view, in true proportions. A page in the browser is served until
    Ctrl-C, on this computer only unless --host says otherwise.

    \b
    Examples:
      eschorty view scan/scan.pcd
      eschorty view scan/scan.pcd --out depth.pdf
      eschorty view scan/scan.pcd --out growing.gif
      eschorty view scan/scan.pcd --window
      eschorty view scan/scan.pcd --browser
      eschorty view --live --allow-scan
    """  # noqa: D301
    if (cloud is None) != live or window + browser + live > 1 or (allow_scan and not live):
        raise click.UsageError(
            "give CLOUD, if wanted with --window or --browser; or --live, if wanted with "
            "--allow-scan, and no CLOUD"
        )
    if not (browser or live):
        refuse_given(("host", "port"), "belongs to --browser or --live")
    if out is not None and (window or browser or live):
        raise click.UsageError("--out is the picture; --window, --browser and --live draw none")
    if cloud is None:
        _serve_instrument(allow_scan, host, port)
    elif window:
        _open_window(_read(cloud)[0], cloud.name)
    elif browser:
        from eschorty_ros.viewer.page import open_when_served

        points, _ = _read(cloud)
        open_when_served(host, port)
        serve_cloud(points, host, port)
    else:
        _draw(cloud, out or cloud.with_suffix(".png"))


def _serve_instrument(allow_scan: bool, host: str, port: int) -> None:
    from eschorty_ros.viewer.page import load_viser, open_when_served

    node = nodes_module("viewer.node", make="setup")
    load_viser()
    open_when_served(host, port)
    values = {"allow_scan": str(allow_scan).lower(), "host": host, "port": str(port)}
    given = [part for name, value in values.items() for part in ("-p", f"{name}:={value}")]
    # As the launch files do it; without effect unless ROS_SECURITY_ENABLE is set.
    given += ["--enclave", "/eschorty/viewer"]
    if node.main(["--ros-args", "-r", "__ns:=/eschorty", *given]):
        raise DeviceError("the viewer ended with an error; see the message above")


def _read(cloud: Path) -> tuple[Points, bool]:
    """Return the points that can be drawn, and whether the cloud is one of this package."""
    from eschorty_ros.core.storage import read_cloud

    try:
        return _drawable(read_cloud(cloud), cloud), True
    except OtherFormatError:
        return _drawable(_read_other(cloud), cloud), False


def _draw(cloud: Path, target: Path) -> None:
    from eschorty_ros.report import figures

    grows = target.suffix.lower() == ".gif"
    if grows:
        check_output(target, cloud)
    else:
        check_picture(target, cloud)
    points, own = _read(cloud)
    report_replaced(target)
    if grows:
        _draw_growing(points, own, target)
    else:
        draw = figures.scan_figure if own else figures.cloud_figure
        figures.save(draw(points, title=f"{cloud.name}: {len(points):,} points"), target)
    click.echo(str(target))


def serve_cloud(points: Points, host: str, port: int) -> None:
    """Serve a page with the points until Ctrl-C."""
    from eschorty_ros.viewer.growing_cloud import GrowingCloud
    from eschorty_ros.viewer.page import Page
    from eschorty_ros.viewer.status import points_text

    shown = GrowingCloud()
    page = Page(shown, host=host, port=port)
    shown.add(points)
    click.echo(f"page at {page.url} (Ctrl-C ends it)")
    try:
        while True:
            page.show(points_text)
            time.sleep(_SHOW_S)
    except KeyboardInterrupt:
        return
    finally:
        page.stop()


def _draw_growing(points: Points, own: bool, target: Path) -> None:
    from eschorty_ros.report.growing_scan import write_growing_scan

    if not own:
        raise FormatError(f"{target} needs times and columns; give a cloud of this package")
    with progress_bar("drawing") as report:
        write_growing_scan(points, target, report)


def _read_other(cloud: Path) -> Points:
    """Return the points of a cloud in any form that Open3D reads; only x, y and z are known."""
    import numpy as np

    from eschorty_ros.core.storage import POINT_DTYPE
    from eschorty_ros.simulation.scenes import load_open3d

    open3d = load_open3d(f"{cloud}: a cloud of another program")
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    xyz = np.asarray(open3d.io.read_point_cloud(str(cloud)).points)
    if not len(xyz):
        raise FormatError(f"{cloud}: no points with x, y and z found; give a cloud with points")
    points = np.zeros(len(xyz), POINT_DTYPE)
    for axis, values in zip("xyz", xyz.T, strict=True):
        points[axis] = values
    return points


def _drawable(points: Points, cloud: Path) -> Points:
    """Return the points that have a place and a time; the others are counted."""
    import numpy as np

    good = np.ones(len(points), bool)
    for name, bound in _BOUNDS.items():
        good &= np.abs(points[name]) <= bound
    if not good.any():
        raise FormatError(
            f"{cloud}: none of its {len(points):,} points has a finite place and time; "
            "give a cloud with points"
        )
    if not good.all():
        left_out = f"{np.count_nonzero(~good):,} of {len(points):,} points"
        warn(f"{left_out} are not finite or beyond bounds")
    return points[good]


def _open_window(points: Points, title: str) -> None:
    import numpy as np

    from eschorty_ros.simulation.scenes import load_open3d

    open3d = load_open3d("--window")
    xyz = np.column_stack([points[axis] for axis in "xyz"]).astype(np.float64)
    shape = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz))
    # Its loop calls no handler of Python. What ``nohup`` ignores stays ignored.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    open3d.visualization.draw_geometries([shape], window_name=title)
