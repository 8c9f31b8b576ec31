"""A ROS domain that no other instrument on this host uses."""

from __future__ import annotations

import random
import socket

from eschorty_ros.core.errors import DeviceError


def free_domain() -> int:
    """Find a ROS domain (1 to 101) whose discovery port nobody on this host holds.

    Raises
    ------
    DeviceError
        When every one is taken.
    """
    domains = list(range(1, 102))
    random.SystemRandom().shuffle(domains)
    for domain in domains:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7400 + 250 * domain + 10))
            except OSError:
                continue
            return domain
    raise DeviceError("every ROS domain from 1 to 101 is taken on this host; set ROS_DOMAIN_ID")
