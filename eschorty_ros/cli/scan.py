"""`eschorty scan`."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eschorty_ros.cli.console import accuracy_rows, pairs, progress_bar, warn
from eschorty_ros.cli.files import IN_FILE, report_replaced
from eschorty_ros.cli.instrument import nodes_module
from eschorty_ros.cli.options import (
    Integer,
    check_sweep,
    page_options,
    refuse_given,
    stated,
    sweep_options,
)
from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.live.sweep_coverage import PASSES_MAX

if TYPE_CHECKING:
    from eschorty_ros.nodes.one_process.composition import Tables
    from eschorty_ros.nodes.one_process.scan import ScanJob, ScanResult
    from eschorty_ros.report.accuracy import Sweep
    from eschorty_ros.simulation.scenes import Scene


@click.command("scan")
@sweep_options
@click.option(
    "--keep",
    type=click.Choice(["all", "good"]),
    default="all",
    show_default=True,
    help="Points to keep; good ones have no flag.",
)
@click.option(
    "--hardware",
    metavar="CONFIG",
    type=IN_FILE,
    help="Scan with real devices: a YAML file of parameters by node; docs/hardware.md.",
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("scan"),
    show_default=True,
    help="Folder for scan.pcd and scan.png.",
)
@click.option(
    "--passes",
    type=Integer(1, PASSES_MAX),
    default=1,
    show_default=True,
    help="Sweeps, every second one back; their points are joined.",
)
@click.option(
    "--organized",
    is_flag=True,
    help="Write scan.pcd as a height map of profiles and columns, NaN where nothing is.",
)
@click.option(
    "--record",
    type=click.Path(file_okay=False, path_type=Path),
    help="New folder for a recording, which `eschorty reconstruct` turns into the same points.",
)
@click.option(
    "--live", is_flag=True, help="Show the scan on a page in the browser, until Ctrl-C (viser)."
)
@page_options
def command(
    calibration: str,
    keep: str,
    hardware: Path | None,
    out: Path,
    record: Path | None,
    live: bool,
    host: str,
    port: int,
    **scan: Any,
) -> None:
    """Scan a scene with camera, laser, stage, reconstruction and scanner nodes.

    The nodes run in this process over ordinary ROS 2 topics, their drivers at devices that another
    process emulates around a simulated scene, or with --hardware at real ones, without --scene,
    --pixels, --effects and --seed. Written are scan.pcd (the cloud, metres, in eschorty_base) and
    scan.png (depth map, 3-D view, and of a simulated scene the error map); the error of a simulated
    scene is printed, too. The noise depends on timing, so two runs differ slightly. For a
    second of the sweep the simulation takes some 13 s at 1 kHz and minutes at 20 kHz.

    \b
    Examples:
      eschorty scan
      eschorty scan --scene sphere --speed 20 --out sphere
      eschorty scan --scene face --live
      eschorty scan --scene part.ply --frequency 140 --calibration nominal
      eschorty scan --record rec && eschorty reconstruct rec
      eschorty scan --hardware lab.yaml --calibration my.yaml
    """  # noqa: D301
    from eschorty_ros.cli.view import serve_cloud
    from eschorty_ros.core.base.files import check_writable
    from eschorty_ros.core.storage.recording_writer import make_recording_folder
    from eschorty_ros.viewer.page import load_viser, open_when_served, page_url

    check_sweep(scan["start_mm"], scan["stop_mm"])
    if hardware is not None:
        refuse_given(("scene", "pixels", "effects", "seed"), "is for a simulated scene")
    if not live:
        refuse_given(("host", "port"), "belongs to --live")
    one_scan = nodes_module("one_process.scan", make="scan")
    tables = None
    if hardware is not None:
        tables, calibration, keep = _hardware(hardware, calibration, keep)
    job = one_scan.ScanJob(
        calibration=calibration,
        keep=keep,
        hardware=tables,
        record=record,
        page=(host, port) if live else None,
        **scan,
    )
    _check(job)
    one_scan.check_job(job)
    if live:
        load_viser()
        open_when_served(host, port)
        click.echo(f"page at {page_url(host, port)}", err=True)
    with _made(out, record), progress_bar("scanning") as feedback:
        out.mkdir(parents=True, exist_ok=True)
        check_writable(out / "scan.pcd")
        if record is not None:
            make_recording_folder(record)
        result = one_scan.scan_once(job, feedback)
    finish(job, result, out)
    if live:
        # The browser comes back to the same address by itself.
        serve_cloud(result.points, host, port)


def _hardware(file: Path, calibration: str, keep: str) -> tuple[Tables, str, str]:
    """Return the nodes' parameters, and calibration and ``keep``: as given, else the file's."""
    tables = nodes_module("one_process.hardware_file", make="scan").read_hardware(file)
    values = {"calibration": calibration, "keep": keep}
    given = {name: values[name] for name in stated(values)}
    values |= tables.get("reconstruction", {}) | given
    return tables, values["calibration"], values["keep"]


@contextlib.contextmanager
def _made(*folders: Path | None) -> Iterator[None]:
    """Remove those of the folders that are new and empty where the block fails."""
    new = [folder for folder in folders if folder is not None and not folder.exists()]
    try:
        yield
    except BaseException:
        for folder in new:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _check(job: ScanJob) -> None:
    """Refuse an unknown scene, calibration or effect before any node starts."""
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.simulation.scenes import named
    from eschorty_ros.simulation.world import Effects

    named(job.scene)
    load_calibration(job.calibration)
    Effects.parse(job.effects)


def finish(job: ScanJob, result: ScanResult, out: Path) -> None:
    """Write cloud and picture, print the table; DeviceError for a failed or empty scan."""
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.core.storage import write_cloud
    from eschorty_ros.report import accuracy, figures
    from eschorty_ros.simulation.scenes import names as scenes
    from eschorty_ros.simulation.world import Effects

    if len(result.points):
        cloud = result.points if result.organized is None else result.organized
        report_replaced(out / "scan.pcd", out / "scan.png")
        write_cloud(out / "scan.pcd", cloud)
        (out / "scan.png").unlink(missing_ok=True)
    if not result.success or not len(result.points):
        kept = f" ({len(result.points):,} points kept in {out / 'scan.pcd'})"
        raise DeviceError(result.message + (kept if len(result.points) else ""))
    calibration = load_calibration(job.calibration)
    model, direction = calibration.model(), calibration.stage_direction
    title = f"{job.frequency_hz:g} Hz, {job.speed_mm_s:g} mm/s, {job.calibration}"
    if job.hardware is not None:
        figures.save(figures.scan_figure(result.points, None, title, direction), out / "scan.png")
        _print(result, {}, out)
        return
    truth = scenes.named(job.scene, model)
    error_mm = accuracy.range_error_mm(result.points, truth, model, direction)
    sweep = accuracy.Sweep(job.start_mm, job.stop_mm, job.speed_mm_s, job.frequency_hz, job.passes)
    seen = Effects.parse(job.effects).scene(truth, model)
    measured = accuracy.measure(result.points, seen, model, sweep, direction, error_mm)
    title = f"{job.scene}: {title}"
    if math.isfinite(measured.error_median_mm):
        title += f"; median |error| {measured.error_median_mm:.2f} mm"
    figures.save(figures.scan_figure(result.points, error_mm, title, direction), out / "scan.png")
    rows = accuracy_rows(measured) | {"seconds of sweep": f"{sweep.seconds:.2f}"}
    _print(result, rows, out)
    if result.recording:
        _write_truth(result, seen, sweep)


def _write_truth(result: ScanResult, scene: Scene, sweep: Sweep) -> None:
    """Write the scene's ranges to the scan's recording; DeviceError where that is not complete."""
    from eschorty_ros.core.storage import TRUTH_FILE, load_recording, write_truth_csv
    from eschorty_ros.report.accuracy import recorded_truth

    try:
        recording = load_recording(result.recording)
    except EschortyError as error:
        raise DeviceError(f"the recording is not complete: {result.message or error}") from error
    try:
        known = recorded_truth(result.points, scene, recording, sweep)
        columns = (known[name] for name in ("t_us", "column", "range_mm"))
        write_truth_csv(Path(result.recording, TRUTH_FILE), *columns)
    except EschortyError as error:
        warn(f"the recording has no truth: {error}")


def _print(result: ScanResult, rows: dict[str, str], out: Path) -> None:
    """Print verdict and files, counts, ``rows``, and what was lost."""
    recorded = {"recording": result.recording} if result.recording else {}
    pairs(
        f"{result.verdict}, {result.completeness:.1%}: {out / 'scan.pcd'}, {out / 'scan.png'}",
        {
            "profiles": f"{result.profiles:,}",
            "points": f"{len(result.points):,}",
            "events": f"{result.events:,} ({result.events_dropped:,} dropped, "
            f"{result.packets_lost:,} packets lost)",
            **recorded,
            **rows,
        },
    )
    if result.message:
        warn(result.message)
