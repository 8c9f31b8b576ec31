"""Heartbeats: the text that identifies the sender, and when a device's health stops them.

The text is ``<place> <pid>``, and ``<place> <pid> stopped`` in the last ones. The place is the same
for two processes of the same process id space.
"""

from __future__ import annotations

import os
import re
import socket
from dataclasses import dataclass
from functools import cache

from eschorty_ros.hardware.base.stalls import process_fault

_STOPPED = "stopped"
# Any program may publish a heartbeat; a text of another form or length is not read.
_TEXT = re.compile(rf"(\S{{1,200}}) ([0-9]{{1,10}})( {_STOPPED})?", re.ASCII)
# Each check wakes the process, which costs more than what is checked.
CHECK_S = 0.05
PERIOD_S = 0.1
LAST_HEARTBEATS = 3
# Shorter than the time after which a driver reports a device without answers; a running device is
# read again within this many checks.
STALL_S = 0.3
RECOVERY_CHECKS = 4


@cache
def place() -> str:
    """Return host and process id space of this process."""
    return f"{socket.gethostname()}/{os.stat('/proc/self/ns/pid').st_ino}"


@dataclass(frozen=True, slots=True)
class Sender:
    """The process that sends a heartbeat."""

    place: str
    pid: int

    def fault(self) -> str:
        """Return why the process does not run, ``""`` while it does or on another host."""
        fault = process_fault(self.pid) if self.place == place() else ""
        return f"process {self.pid} is {fault}" if fault else ""


def heartbeat_text(*, stopped: bool) -> str:
    """Return the text of this process's heartbeat."""
    return f"{place()} {os.getpid()}" + f" {_STOPPED}" * stopped


def read_heartbeat(text: str) -> tuple[Sender | None, bool]:
    """Return a heartbeat's sender, ``None`` for any other text, and whether it reports a stop."""
    found = _TEXT.fullmatch(text)
    if found is None:
        return None, False
    return Sender(found[1], int(found[2])), found[3] is not None


class HeartbeatSchedule:
    """Decides at every check, ``CHECK_S`` apart, whether a heartbeat is due and what it reports.

    While the device is healthy one is due every 0.1 s, and the last three report that it stopped.
    After a stall of this process a device that was healthy has 0.2 s to be read again.

    Public attributes:
    - ``healthy``: True when the last heartbeat reported a healthy device.
    - ``left``: Heartbeats that are to report a stop.
    """

    def __init__(self) -> None:
        self.healthy = False
        self.left = 0
        self._recovery_checks = 0
        self._sent_s = 0.0

    def check(self, healthy: bool, stall_s: float, now_s: float) -> str | None:
        """Return the text of the heartbeat that is due, ``None`` when none is.

        - ``healthy``: Whether the device is healthy now.
        - ``stall_s``: Stall of this process since the check before.
        - ``now_s``: Steady clock.
        """
        self._recovery_checks = (
            RECOVERY_CHECKS if stall_s > STALL_S else max(self._recovery_checks - 1, 0)
        )
        healthy |= self.healthy and self._recovery_checks > 0
        if healthy:
            self.left = LAST_HEARTBEATS
        due = healthy != self.healthy or now_s - self._sent_s >= PERIOD_S
        if not due or self.left == 0:
            return None
        self.healthy, self._sent_s = healthy, now_s
        self.left -= not healthy
        return heartbeat_text(stopped=not healthy)
