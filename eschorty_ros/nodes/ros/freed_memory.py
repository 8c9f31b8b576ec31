"""Memory that this process has freed: kept for the next message, then given back."""

from __future__ import annotations

import ctypes
import time

_PERIOD_S = 10.0
# Of glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
# The arrays of a message are smaller, those of a scan larger.
_MMAP_BYTES, _TRIM_BYTES = 8_000_000, 32_000_000


class FreedMemory:
    """Keeps what has been freed for what comes next, and gives it back every 10 s.

    By itself glibc gives the arrays of a message back at once, and each of their pages costs a
    fault at the next. But it keeps what is free below a block in use: 100 MB after messages have
    waited for a second. Another C library is left alone.
    """

    def __init__(self) -> None:
        library = ctypes.CDLL(None)
        self._trim = getattr(library, "malloc_trim", None)
        self._trimmed_s = time.monotonic()
        if self._trim is not None:
            library.mallopt(_M_MMAP_THRESHOLD, _MMAP_BYTES)
            library.mallopt(_M_TRIM_THRESHOLD, _TRIM_BYTES)

    def trim(self) -> None:
        """Give it back when that is due."""
        now_s = time.monotonic()
        if self._trim is not None and now_s - self._trimmed_s >= _PERIOD_S:
            self._trimmed_s = now_s
            self._trim(0)
