"""`eschorty simulate`."""

from __future__ import annotations

from pathlib import Path

import click

from eschorty_ros.cli.console import pairs, progress_bar
from eschorty_ros.cli.options import Number, check_sweep, sweep_options
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import remove_abandoned


@click.command("simulate")
@sweep_options
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help="Folder to make; must be new or empty.",
)
@click.option(
    "--duty",
    type=Number(0, 1, min_open=True, max_open=True),
    default=0.5,
    show_default=True,
    help="Share of the period with the laser on.",
)
def command(
    scene: str,
    out: Path,
    frequency_hz: float,
    duty: float,
    speed_mm_s: float,
    start_mm: float,
    stop_mm: float,
    calibration: str,
    pixels: str,
    effects: str,
    seed: int,
) -> None:
    """Simulate a recording of a scene, with its truth. Needs no ROS.

    The folder holds events.raw, stage.csv, laser.yaml, calibration.yaml and truth.csv; the same
    options and seed give the same events.

    \b
    Examples:
      eschorty simulate --scene steps --out rec
      eschorty simulate --scene sphere --frequency 300 --speed 200 --seed 7 --out rec300
      eschorty simulate --scene plane --effects ambient=0.5,ghost=0.4,ghost_mm=16 --out sunny
    """  # noqa: D301
    check_sweep(start_mm, stop_mm)
    remove_abandoned(out)
    if out.is_dir() and any(out.iterdir()):
        raise ArgumentError(f"{out} is not empty; choose a new folder")
    from eschorty_ros.core.modulation import Modulation
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.simulation.pixels import preset
    from eschorty_ros.simulation.scenes import WithinRange, named
    from eschorty_ros.simulation.world import Effects, simulate_recording

    build = load_calibration(calibration)
    shown = named(scene, build.model())
    moved = {}
    if isinstance(shown, WithinRange):
        moved["ranges"] = f"{round(shown.offset_mm, 1) + 0.0} mm + {shown.factor:.5f} x the scene's"
    with progress_bar("simulating") as report:
        recording = simulate_recording(
            out,
            shown,
            build,
            modulation=Modulation(frequency_hz, duty),
            start_mm=start_mm,
            stop_mm=stop_mm,
            speed_mm_s=speed_mm_s,
            seed=seed,
            parameters=preset(pixels),
            effects=Effects.parse(effects),
            progress=report,
        )
    truth = recording.truth
    pairs(
        str(out),
        {
            "events.raw": f"{recording.events_path.stat().st_size / 1e6:.1f} MB",
            **moved,
            "stage": f"{start_mm:g} to {stop_mm:g} mm at {speed_mm_s:g} mm/s",
            "truth": f"{0 if truth is None else len(truth):,} ranges",
        },
    )
