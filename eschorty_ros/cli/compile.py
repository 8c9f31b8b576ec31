"""`eschorty compile`."""

from __future__ import annotations

import time

import click

from eschorty_ros.cli.console import progress_bar


@click.command("compile")
def command() -> None:
    """Compile the numerical kernels, so that the first run is as fast as later ones.

    They are kept in numba's cache: beside the package, or in NUMBA_CACHE_DIR. Without this command
    the first run compiles what it needs, for some minutes.

    \b
    Example:
      eschorty compile
    """  # noqa: D301
    begun_s = time.monotonic()
    with progress_bar("compiling") as report:
        report(0.0, "reconstruction")
        import eschorty_ros.core.calibration  # noqa: F401 - its kernels, too
        from eschorty_ros.core.optics import load_calibration
        from eschorty_ros.core.reconstruction import warm_up

        calibration = load_calibration("config_3")
        warm_up(calibration)
        report(0.8, "simulation")
        from eschorty_ros.simulation import world

        world.warm_up(calibration)
    click.echo(f"compiled in {time.monotonic() - begun_s:.0f} s")
