"""The Fast DDS profile of the nodes."""

from __future__ import annotations

import os

from eschorty_ros.core.base.files import config_folders

PROFILE = "fastdds.xml"
VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
# Fast DDS 2 of these has another format of profiles.
_OLD_DISTRIBUTIONS = ("humble", "iron", "jazzy")


def use_profile() -> None:
    """Make Fast DDS read ``config/fastdds.xml`` unless the user has chosen a profile.

    With its defaults a message lost on a loaded host is repeated after up to 3 s, even on a
    reliable topic. Call it before the first ``rclpy.init`` of the process.
    """
    chosen = any(name in os.environ for name in VARIABLES)
    if chosen or os.environ.get("ROS_DISTRO") in _OLD_DISTRIBUTIONS:
        return
    for folder in config_folders():
        if (folder / PROFILE).is_file():
            os.environ[VARIABLES[0]] = str(folder / PROFILE)
            return
