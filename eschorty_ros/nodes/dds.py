"""Room for large messages in DDS."""

from __future__ import annotations

import os

from eschorty_ros.core.calibration import config_folders

PROFILE = "fastdds.xml"
# The second name is that of Fast DDS 2, which the distributions before Kilted use.
VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
_OLD_DISTRIBUTIONS = ("humble", "iron", "jazzy")


def use_profile() -> None:
    """Make Fast DDS read ``config/fastdds.xml`` unless the user has chosen a profile.

    Its default shared memory of 512 kB holds a few event packets: a host that stalls for some
    50 ms loses packets, which even reliable topics get back only at the next heartbeat, up to 3 s
    later. Must run before the first ``rclpy.init`` of the process.
    """
    if any(name in os.environ for name in VARIABLES):
        return
    variable = VARIABLES[os.environ.get("ROS_DISTRO") in _OLD_DISTRIBUTIONS]
    for folder in config_folders():
        if (folder / PROFILE).is_file():
            os.environ[variable] = str(folder / PROFILE)
            return
