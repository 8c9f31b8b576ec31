"""Cutting the camera's byte stream into packets by age and size."""

from __future__ import annotations

from collections.abc import Iterator

from eschorty_ros.core.base.errors import ArgumentError

SIZE_MAX_BYTES = 256_000
# Every packet costs each subscriber as much as some thousand events: those of a dark scene wait.
_QUIET_BYTES = 8192
_QUIET_AGES = 5
# 0.1 s at the default threshold: the period of the event image, which alone shows what is dark.
_DARK_AGES = 25


class Packetizer:
    """Collects bytes until the packet reaches an age or a size.

    - ``time_threshold_ns``: Age of a packet's first byte at which it is complete; five times that
      for under 8 kB, 25 times that while ``dark``.
    - ``size_threshold``: Bytes of a complete packet, rounded down to 16-bit words.

    Public attributes:
    - ``dark``: True while the laser is known to be off, so that no event makes a point.

    Raises ``ArgumentError`` when ``size_threshold`` is not 2 to 256000.
    """

    def __init__(self, time_threshold_ns: int, size_threshold: int, dark: bool = False) -> None:
        if not 2 <= size_threshold <= SIZE_MAX_BYTES:
            raise ArgumentError(
                f"size_threshold is {size_threshold!r}; choose 2 to {SIZE_MAX_BYTES} bytes"
            )
        self.dark = dark
        self._age_ns = time_threshold_ns
        self._size = size_threshold // 2 * 2
        self._pending = bytearray()
        self._first_ns = 0

    def push(self, data: bytes, arrival_ns: int) -> Iterator[tuple[int, bytes]]:
        """Add ``data``, or ``b""``; yields complete packets: (first arrival, bytes)."""
        if data and not self._pending:
            self._first_ns = arrival_ns
        self._pending += data
        while len(self._pending) >= self._size:
            yield self._first_ns, bytes(self._pending[: self._size])
            del self._pending[: self._size]
            self._first_ns = arrival_ns
        if self._pending and arrival_ns - self._first_ns >= self._ages * self._age_ns:
            yield from self.flush()

    @property
    def _ages(self) -> int:
        if self.dark:
            return _DARK_AGES
        return _QUIET_AGES if len(self._pending) < _QUIET_BYTES else 1

    def flush(self) -> Iterator[tuple[int, bytes]]:
        """Yield the incomplete packet."""
        if self._pending:
            yield self._first_ns, bytes(self._pending)
            self._pending.clear()
