"""Bounded queue between the receiving and the publishing thread; losses are marked."""

from __future__ import annotations

import threading
import time
from collections import deque

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.hardware.base.protocols import EventChunk

BYTES_MAX = 64 << 20


class ChunkQueue:
    """Chunks of complete 16-bit words in order; a gap or restart marks the next chunk.

    - ``bytes_max``: Bytes that may wait; more is dropped and counted.

    Public attributes:
    - ``received_bytes``, ``dropped_bytes``, ``drops``, ``gaps``, ``restarts``: Bytes put in, bytes
      and chunks dropped because the queue was full, gaps of any origin, and starts of the stream.
    """

    def __init__(self, bytes_max: int = BYTES_MAX) -> None:
        self.received_bytes = 0
        self.dropped_bytes = 0
        self.drops = 0
        self.gaps = 0
        self.restarts = 0
        self._bytes_max = bytes_max
        self._waiting_bytes = 0
        self._chunks: deque[EventChunk] = deque()
        self._changed = threading.Condition()
        self._odd = b""
        self._gap = False
        self._restarted = False
        self._failure: DeviceError | None = None
        self._closed = True

    @property
    def waiting_bytes(self) -> int:
        """Return the bytes in the queue."""
        return self._waiting_bytes

    def open(self) -> None:
        """Start a stream: empty the queue, mark the next chunk as a restart."""
        with self._changed:
            self._chunks.clear()
            self._waiting_bytes = 0
            self._failure = None
            self._closed = False
            self._restart()

    def close(self) -> None:
        """Wake waiting readers; chunks in the queue can still be read."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def put(self, data: bytes, arrival_ns: int) -> None:
        """Add bytes; an odd last byte waits for the second half of its word."""
        with self._changed:
            self.received_bytes += len(data)
            data = self._odd + data
            size = len(data) & ~1
            self._odd = data[size:]
            if not size:
                return
            if self._waiting_bytes + size > self._bytes_max:
                self.drops += 1
                self.dropped_bytes += size
                self._mark_gap()
                return
            chunk = EventChunk(data[:size], arrival_ns, self._gap, self._restarted)
            self._gap = self._restarted = False
            self._chunks.append(chunk)
            self._waiting_bytes += size
            self._changed.notify_all()

    def mark_gap(self) -> None:
        """Mark that bytes were lost before the next ones."""
        with self._changed:
            self._odd = b""
            self._mark_gap()

    def mark_restart(self) -> None:
        """Mark that the next bytes start a new stream."""
        with self._changed:
            self._restart()

    def fail(self, error: DeviceError) -> None:
        """Make ``get`` raise ``error`` once the queue is empty."""
        with self._changed:
            self._failure = error
            self._changed.notify_all()

    def get(self, timeout_s: float) -> EventChunk | None:
        """Return the oldest chunk, ``None`` after ``timeout_s`` without one or after ``close``.

        Raises the ``DeviceError`` that was given to ``fail``.
        """
        end_s = time.monotonic() + timeout_s
        with self._changed:
            while not self._chunks:
                if self._failure is not None:
                    raise self._failure
                left_s = end_s - time.monotonic()
                if self._closed or left_s <= 0.0:
                    return None
                self._changed.wait(left_s)
            chunk = self._chunks.popleft()
            self._waiting_bytes -= len(chunk.data)
            return chunk

    def _restart(self) -> None:
        self._odd = b""
        self._gap = False
        self._restarted = True
        self.restarts += 1

    def _mark_gap(self) -> None:
        # A gap before a restart does not count: nothing of the new stream is missing.
        if not self._gap and not self._restarted:
            self._gap = True
            self.gaps += 1
