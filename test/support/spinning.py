"""An executor that a thread spins for a while."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from rclpy.executors import Executor

_TURN_S = 0.05


@contextlib.contextmanager
def spinning(executor: Executor) -> Iterator[None]:
    """Within it a thread spins ``executor``, which is shut down at the end.

    Not by ``executor.spin``: that would still use what shutting down destroys.
    """
    ending = threading.Event()

    def spin() -> None:
        while not ending.is_set():
            executor.spin_once(timeout_sec=_TURN_S)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()
        executor.shutdown()
