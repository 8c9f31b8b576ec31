"""Memory that this process has freed, for the system to use."""

from __future__ import annotations

import ctypes
import time

_PERIOD_S = 10.0


class FreedMemory:
    """Gives what has been freed back to the system, every 10 s.

    glibc keeps what is free below a block in use: 100 MB after messages have waited for a second.
    Another C library is left alone.
    """

    def __init__(self) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._trimmed_s = time.monotonic()

    def trim(self) -> None:
        """Give it back if it is time to."""
        now_s = time.monotonic()
        if self._trim is not None and now_s - self._trimmed_s >= _PERIOD_S:
            self._trimmed_s = now_s
            self._trim(0)
