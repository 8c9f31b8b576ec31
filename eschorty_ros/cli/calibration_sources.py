"""Where `eschorty calibrate` takes its targets from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.console import progress_bar
from eschorty_ros.core.base.errors import FitError

if TYPE_CHECKING:
    from eschorty_ros.core.calibration import KnownTarget, Targets
    from eschorty_ros.core.optics import Calibration


def recorded(
    source: Path,
    design: Calibration,
    distances: str | None,
    moving: float | None,
    range_per_stage: float,
    range_sigma: float,
    blocks: int = 1,
) -> Targets:
    """Find the targets of a recording: posts, or one target moved by the stage.

    ``blocks`` is how many targets stand side by side in every profile of a moving one.

    Raises
    ------
    EschortyError
        When the recording or the distances are at fault, or no post lies where they say.
    """
    from eschorty_ros.core.calibration import recorded_moving_target, recorded_posts
    from eschorty_ros.core.storage import load_recording

    recording = load_recording(source)
    with progress_bar("reading") as report:

        def progress(done: int, total: int) -> None:
            report(done / max(total, 1), "")

        if moving is not None:
            return recorded_moving_target(
                recording, design, moving, range_per_stage=range_per_stage, blocks=blocks,
                progress=progress,
            )  # fmt: skip
        match = recorded_posts(recording, known(distances, range_sigma), design, progress)
    for line in match.rejected:
        click.echo(f"left out: {line}")
    if match.targets is None:
        raise FitError(
            f"--distances is {distances}; no post lies where they say, check the ranges and "
            "--nominal"
        )
    return match.targets


def known(distances: str | None, range_sigma: float) -> list[KnownTarget]:
    """Read the posts' ranges: a list in mm, a CSV file, or those of the simulated scene.

    Raises
    ------
    EschortyError
        When the file cannot be read.
    """
    from eschorty_ros.core.calibration import KnownTarget, read_distances
    from eschorty_ros.core.optics import config_file

    if distances is None:
        return read_distances(config_file("posts.csv"))
    try:
        ranges = [float(part) for part in distances.split(",")]
    except ValueError:
        return read_distances(distances, sigma_range_mm=range_sigma)
    return [KnownTarget(range_mm, range_sigma) for range_mm in ranges]
