"""End this process when the process that launched it ends."""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Callable

from eschorty_ros.hardware.base.stalls import process_ended

VARIABLE = "ESCHORTY_LAUNCHER"
_POLL_S = 0.1


def launched_environment() -> dict[str, str]:
    """Return the environment that makes a process end with this one."""
    return {VARIABLE: str(os.getpid())}


def launched() -> bool:
    """Return whether this process ends with another one."""
    return VARIABLE in os.environ


def end_with_launcher() -> None:
    """Send this process SIGTERM as soon as its launcher is gone; nothing without a launcher."""
    text = os.environ.get(VARIABLE, "")
    if not text.isdecimal():
        return
    gone = _waiting(int(text))

    def watch() -> None:
        gone()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="launcher", daemon=True).start()


def _waiting(pid: int) -> Callable[[], object]:
    """Return a function that returns when the process is gone."""
    try:
        poll = select.poll()
        poll.register(os.pidfd_open(pid), select.POLLIN)
    except OSError:

        def wait() -> None:
            while not process_ended(pid):
                time.sleep(_POLL_S)

        return wait
    return poll.poll
