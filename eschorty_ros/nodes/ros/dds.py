"""The Fast DDS profile of the nodes."""

from __future__ import annotations

import os

from eschorty_ros.core.base.files import config_path

HERE, NETWORK = "fastdds.xml", "two_hosts.xml"
VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
# With it the profile sets how histories hold their messages, without it rmw_fastrtps does.
_HISTORIES = "RMW_FASTRTPS_USE_QOS_FROM_XML"
# Fast DDS 2 of these has another format of profiles.
_OLD_DISTRIBUTIONS = ("humble", "iron", "jazzy")


def use_profile() -> None:
    """Make Fast DDS read a profile of ``config/`` unless the user has chosen one.

    ``fastdds.xml`` stays on this host; ``two_hosts.xml`` where the discovery range is set to
    another value. With the defaults of Fast DDS a message lost on a loaded host is repeated after
    up to 3 s, even on a reliable topic. Call it before the first ``rclpy.init`` of the process.
    """
    here = os.environ.setdefault(RANGE, "LOCALHOST") == "LOCALHOST"
    chosen = any(name in os.environ for name in VARIABLES)
    if chosen or os.environ.get("ROS_DISTRO") in _OLD_DISTRIBUTIONS:
        return
    profile = config_path(HERE if here else NETWORK)
    if profile is not None:
        os.environ[VARIABLES[0]] = str(profile)
        os.environ.setdefault(_HISTORIES, "1")
        if here:
            # LOCALHOST would add shared memory to what the profile names.
            os.environ[RANGE] = "SUBNET"
