"""Room for large messages in DDS."""

from __future__ import annotations

import os

from eschorty_ros.core.calibration import config_folders

PROFILE = "fastdds.xml"
VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
# Their Fast DDS 2 spells profiles differently.
_OLD_DISTRIBUTIONS = ("humble", "iron", "jazzy")


def use_profile() -> None:
    """Make Fast DDS read ``config/fastdds.xml`` unless the user has chosen a profile.

    Its default shared memory of 512 kB holds a few event packets: a host that stalls for some
    50 ms loses packets, which even reliable topics get back only at the next heartbeat, up to 3 s
    later. Must run before the first ``rclpy.init`` of the process.
    """
    chosen = any(name in os.environ for name in VARIABLES)
    if chosen or os.environ.get("ROS_DISTRO") in _OLD_DISTRIBUTIONS:
        return
    for folder in config_folders():
        if (folder / PROFILE).is_file():
            os.environ[VARIABLES[0]] = str(folder / PROFILE)
            return
