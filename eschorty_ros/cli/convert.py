"""`eschorty convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from eschorty_ros.cli.console import progress_bar, warn
from eschorty_ros.cli.options import recorded_options, refuse_given

STORAGES = ("mcap", "sqlite3")


@click.command("convert")
@click.argument("source", type=click.Path(exists=True, path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@click.option(
    "--storage",
    type=click.Choice(STORAGES),
    default="mcap",
    show_default=True,
    help="Storage of a bag that is written.",
)
@recorded_options
def command(
    source: Path,
    target: Path,
    storage: str,
    frequency: float | None,
    calibration: str | None,
    packet_period: float,
) -> None:
    """Make a bag of the recording SOURCE, or a recording of the bag SOURCE; TARGET is new.

    A bag is the folder of a rosbag2 or one .mcap or .db3 file, with camera/events (or another
    topic of event_camera_msgs/EventPacket), stage/odom (or another nav_msgs/Odometry), laser/state
    and reconstruction/calibration; --frequency and --calibration replace the last two. Needs
    rosbags, and no ROS.

    \b
    Examples:
      eschorty convert rec bag
      eschorty convert rec bag --storage sqlite3
      eschorty convert bag again && eschorty reconstruct again
      eschorty convert driver.mcap rec --frequency 70 --calibration my.yaml
    """  # noqa: D301
    from eschorty_ros.core.storage import load_recording
    from eschorty_ros.live.bag_conversion import recording_to_bag
    from eschorty_ros.live.bag_files import is_bag

    if is_bag(source):
        refuse_given(["storage"], "is for a bag that is written; TARGET is a recording")
        if lacking := recording_of(source, target, frequency, calibration, packet_period):
            warn(lacking)
        click.echo(str(target))
        return
    refuse_given(("frequency", "calibration", "packet_period"), "is for a bag; SOURCE is none")
    recording = load_recording(source)
    with progress_bar("converting") as report:
        recording_to_bag(recording, target, storage, report)
    click.echo(str(target))


def recording_of(
    bag: Path,
    folder: Path,
    frequency: float | None,
    calibration: str | None,
    packet_period_ms: float,
    settings: dict[str, Any] | None = None,
) -> str:
    """Write the recording of a bag, with these settings; return what it lacks."""
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.live.bag_conversion import bag_to_recording

    build = None if calibration is None else load_calibration(calibration)
    return bag_to_recording(bag, folder, build, frequency, settings, 1e-3 * packet_period_ms)
