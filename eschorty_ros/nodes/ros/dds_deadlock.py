"""A deadlock of Fast DDS 3: its threads wait for each other, and the node sends nothing more."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

from eschorty_ros.core.base.errors import DeviceError

_PERIOD_S = 2.0
# While no thread of DDS runs for so long, messages do not wait, however busy the computer is.
_LOOKS_MAX = 5
_SELF = Path("/proc/self")


class DdsDeadlockError(DeviceError):
    """The threads of DDS wait for each other."""


class DdsDeadlock:
    """Looks every 2 s whether messages wait at the process's sockets while no DDS thread runs.

    Fast DDS 3.2 may lock up when a publisher or client ends while it is answered: the thread that
    removes it waits for the one of the timers, which waits for a lock of the first (upstream issue
    6502). Names of threads are those of Fast DDS; with another DDS nothing is found.
    """

    def __init__(self) -> None:
        self._looked_s = time.monotonic()
        self._switches: dict[Path, int] = {}
        self._ran: Path | None = None
        self._looks = 0

    def look(self) -> None:
        """Look at sockets and threads when that is due.

        Raises ``DdsDeadlockError`` after 5 looks in a row that found the threads blocked. Looks
        count, not time: a process that was stopped finds messages, too, when it continues.
        """
        now_s = time.monotonic()
        if now_s - self._looked_s < _PERIOD_S:
            return
        self._looked_s = now_s
        self._looks = 0 if self._threads_run() or not _messages_wait() else self._looks + 1
        if self._looks >= _LOOKS_MAX:
            raise DdsDeadlockError(
                "DDS takes no messages any more, its threads wait for each other (a defect of "
                "Fast DDS 3, upstream issue 6502); start the node again"
            )

    def _threads_run(self) -> bool:
        """Return whether a thread of DDS has run since the look before, or none is known."""
        # First the one that ran the last time: to look at all threads costs 5 ms.
        ran = self._ran
        if ran is not None and (switches := _switches(ran)) != self._switches[ran]:
            self._switches[ran] = switches
            return True
        before = self._switches
        self._switches = {task: _switches(task) for task in _dds_threads()}
        since = {task: count - before.get(task, 0) for task, count in self._switches.items()}
        self._ran = max(since, key=since.__getitem__, default=None)
        return any(since.values()) or not since


def _dds_threads() -> list[Path]:
    """Return the folders of the threads of DDS in this process."""
    tasks = []
    for task in (_SELF / "task").glob("*"):
        # A thread may end in between.
        with contextlib.suppress(OSError):
            if task.joinpath("comm").read_text().startswith("dds."):
                tasks.append(task)
    return tasks


def _switches(task: Path) -> int:
    """Return the context switches of a thread, 0 after its end."""
    try:
        lines = task.joinpath("status").read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in lines if "ctxt_switches" in line)


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
