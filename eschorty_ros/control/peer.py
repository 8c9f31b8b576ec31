"""Who sends a sign of life, and whether that process still runs; no ROS.

A beat's ``frame_id`` says ``<place> <pid>``, or ``<place> <pid> stopped`` for the last ones. The
place is the same for two processes that see each other's process ids.
"""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from functools import cache

from eschorty_ros.hardware.laser_guard.messages import standing_still

_STOPPED = "stopped"


@cache
def place() -> str:
    """Host and process id space of this process."""
    return f"{socket.gethostname()}/{os.stat('/proc/self/ns/pid').st_ino}"


@dataclass(frozen=True, slots=True)
class Peer:
    """A process somewhere."""

    place: str
    pid: int

    def trouble(self) -> str:
        """Why the process does nothing, ``""`` while it runs or where that cannot be seen."""
        why = standing_still(self.pid) if self.place == place() else ""
        return f"process {self.pid} is {why}" if why else ""


def own_sign(*, stopped: bool) -> str:
    """Make this process's sign."""
    words = [place(), str(os.getpid())] + [_STOPPED] * stopped
    return " ".join(words)


def read_sign(text: str) -> tuple[Peer | None, bool]:
    """Read a sign: whose it is (``None`` for another text) and whether it is the last one."""
    match text.split():
        case [where, number] if number.isdecimal():
            return Peer(where, int(number)), False
        case [where, number, word] if number.isdecimal() and word == _STOPPED:
            return Peer(where, int(number)), True
        case _:
            return None, False
