"""Priority of processes and threads that must not wait for other programs."""

from __future__ import annotations

import contextlib
import os

DEVICE_NICE = -10
"""Of emulated devices: real ones do not slow down with the computer."""
GUARD_NICE = -20


def raise_priority(nice: int) -> None:
    """Give this thread, and those it starts later, a nice value where that is permitted."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
