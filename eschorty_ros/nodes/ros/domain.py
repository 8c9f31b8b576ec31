"""A ROS domain that no other instrument on this host uses."""

from __future__ import annotations

import contextlib
import random
import socket

from eschorty_ros.core.base.errors import DeviceError

# First above the ports that Linux gives to any program, then below; people choose small numbers.
_DOMAINS = (*range(215, 233), *range(60, 102))
_HIGH = 215
# The participant of an instrument that still runs need not be its first.
_PARTICIPANTS = 10
# So many at a time, the longest unused first: others on this host need some, too.
_RESERVED_MAX = 24
_reserved: dict[int, None] = {}
"""By last use."""


def free_domain() -> int:
    """Return a ROS domain without a participant on this host, and reserve it.

    It is one from 215 to 232, else from 60 to 101. The reservation ends with this process. The
    next call, in another process or one of the next 23 here, returns another domain as long as
    there is one.

    Raises ``DeviceError`` when every domain is taken.
    """
    domains = list(_DOMAINS)
    random.SystemRandom().shuffle(domains)
    domains.sort(key=lambda domain: domain < _HIGH)
    new = [domain for domain in domains if domain not in _reserved]
    own = [domain for domain in _reserved if domain in domains]
    for domain in (*new, *own) if len(_reserved) < _RESERVED_MAX else (*own, *new):
        if _unused(domain) and _reserve(domain):
            return domain
    raise DeviceError(
        "every ROS domain from 215 to 232 and 60 to 101 is taken on this host; set ROS_DOMAIN_ID"
    )


def _unused(domain: int) -> bool:
    """Return whether no participant holds a discovery port of the domain (RTPS 9.6.1.1)."""
    with contextlib.ExitStack() as probes:
        for participant in range(_PARTICIPANTS):
            probe = probes.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            try:
                probe.bind(("", 7400 + 250 * domain + 10 + 2 * participant))
            except OSError:
                return False
    return True


def _reserve(domain: int) -> bool:
    """Bind a name that only one process of this host can bind, until this process ends."""
    if domain in _reserved:
        _reserved[domain] = _reserved.pop(domain)
        return True
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as name:
        try:
            name.bind(f"\0eschorty_ros domain {domain}")
        except OSError:
            return False
        name.detach()
    _reserved[domain] = None
    return True
