"""A ROS domain that no other instrument on this host uses."""

from __future__ import annotations

import contextlib
import random
import socket

from eschorty_ros.core.base.errors import DeviceError

_DOMAINS = range(1, 102)
# What is left of an instrument need not be its first participant.
_PARTICIPANTS = 10
_reserved: set[int] = set()


def free_domain() -> int:
    """Find a ROS domain (1 to 101) on which nobody on this host is, and reserve it.

    It stays this process's until the process ends: who asks next, here or in another process, gets
    another one as long as there are any.

    Raises
    ------
    DeviceError
        When every one is taken.
    """
    domains = list(_DOMAINS)
    random.SystemRandom().shuffle(domains)
    # Its own ones again only when there is nothing else.
    domains.sort(key=_reserved.__contains__)
    for domain in domains:
        if _silent(domain) and _reserve(domain):
            return domain
    raise DeviceError("every ROS domain from 1 to 101 is taken on this host; set ROS_DOMAIN_ID")


def _silent(domain: int) -> bool:
    """Whether no participant holds its discovery port (RTPS 9.6.1.1)."""
    with contextlib.ExitStack() as probes:
        for participant in range(_PARTICIPANTS):
            probe = probes.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            try:
                probe.bind(("", 7400 + 250 * domain + 10 + 2 * participant))
            except OSError:
                return False
    return True


def _reserve(domain: int) -> bool:
    """Hold a name that only one process of this host can hold, until this process ends."""
    if domain in _reserved:
        return True
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as name:
        try:
            name.bind(f"\0eschorty_ros domain {domain}")
        except OSError:
            return False
        name.detach()
    _reserved.add(domain)
    return True
