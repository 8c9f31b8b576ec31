"""A deadlock of Fast DDS 3: its threads wait for each other, and the node is silent for ever."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from eschorty_ros.core.base.errors import DeviceError

_PERIOD_S = 1.0
# In a second of which no thread of DDS runs, messages do not wait, however busy the computer is.
_LOOKS_MAX = 10
_SELF = Path("/proc/self")


class DdsDeadlockError(DeviceError):
    """The threads of DDS wait for each other."""


class DdsDeadlock:
    """Looks once a second whether messages wait at the process's sockets while no DDS thread runs.

    Fast DDS 3.2 may lock up when a publisher or client ends while it is answered: the thread that
    removes it waits for the one of the timers, which waits for a lock of the first (upstream issue
    6502). Names of threads are those of Fast DDS; with another DDS nothing is found.
    """

    def __init__(self) -> None:
        self._looked_s = time.monotonic()
        self._switches = -1
        self._looks = 0

    def look(self) -> None:
        """Look if it is time to.

        Raises ``DdsDeadlockError`` after 10 looks in a row that found the threads blocked. Looks
        count, not time: a process that was stopped finds messages, too, when it continues.
        """
        now_s = time.monotonic()
        if now_s - self._looked_s < _PERIOD_S:
            return
        self._looked_s = now_s
        before, self._switches = self._switches, sum(_switches())
        blocked = self._switches == before and self._switches > 0 and _messages_wait()
        self._looks = self._looks + 1 if blocked else 0
        if self._looks >= _LOOKS_MAX:
            raise DdsDeadlockError(
                "DDS takes no messages any more, its threads wait for each other (a defect of "
                "Fast DDS 3, upstream issue 6502); start the node again"
            )


def _switches() -> Iterator[int]:
    """Give the context switches of the threads of DDS in this process."""
    for task in (_SELF / "task").glob("*"):
        # A thread may end in between.
        with contextlib.suppress(OSError):
            if task.joinpath("comm").read_text().startswith("dds."):
                for line in task.joinpath("status").read_text().splitlines():
                    name, _, value = line.partition(":")
                    if name.endswith("ctxt_switches"):
                        yield int(value)


def _messages_wait() -> bool:
    """Return whether a UDP socket of this process has messages that nothing has read."""
    sockets = set()
    for link in (_SELF / "fd").glob("*"):
        with contextlib.suppress(OSError):
            sockets.add(os.readlink(link))
    for name in ("udp", "udp6"):
        with contextlib.suppress(OSError):
            for line in (_SELF / "net" / name).read_text().splitlines()[1:]:
                fields = line.split()
                received = int(fields[4].partition(":")[2], 16)
                if received and f"socket:[{fields[9]}]" in sockets:
                    return True
    return False
