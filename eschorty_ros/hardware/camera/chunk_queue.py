"""Bounded queue between the thread that receives and the one that publishes; losses are marked."""

from __future__ import annotations

import threading
import time
from collections import deque

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.hardware.protocols import EventChunk

BYTES_MAX = 64 << 20


class ChunkQueue:
    """Chunks in order, whole words each, with gaps and restarts attached to the next chunk.

    Parameters
    ----------
    bytes_max : int
        Bytes that may wait; what comes on top is dropped and counted.

    Attributes
    ----------
    received_bytes, dropped_bytes, drops, gaps, restarts : int
        Bytes that came in, bytes and chunks dropped because the queue was full, gaps of any
        origin, and new starts of the stream.
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
        """Bytes not taken yet."""
        return self._waiting_bytes

    def open(self) -> None:
        """Begin a stream: forget what waits, mark the next chunk as a restart."""
        with self._changed:
            self._chunks.clear()
            self._waiting_bytes = 0
            self._failure = None
            self._closed = False
            self._begin_anew()

    def close(self) -> None:
        """Wake who waits; what waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def put(self, data: bytes, arrival_ns: int) -> None:
        """Add bytes; a lone last byte waits for its word's other half."""
        with self._changed:
            self.received_bytes += len(data)
            data = self._odd + data
            whole = len(data) & ~1
            self._odd = data[whole:]
            if not whole:
                return
            if self._waiting_bytes + whole > self._bytes_max:
                self.drops += 1
                self.dropped_bytes += whole
                self._lose()
                return
            chunk = EventChunk(data[:whole], arrival_ns, self._gap, self._restarted)
            self._gap = self._restarted = False
            self._chunks.append(chunk)
            self._waiting_bytes += whole
            self._changed.notify_all()

    def mark_gap(self) -> None:
        """Tell that bytes were lost before the next ones."""
        with self._changed:
            self._odd = b""
            self._lose()

    def mark_restart(self) -> None:
        """Tell that the next bytes begin a new stream."""
        with self._changed:
            self._begin_anew()

    def fail(self, error: DeviceError) -> None:
        """Let ``get`` raise ``error`` once everything has been taken."""
        with self._changed:
            self._failure = error
            self._changed.notify_all()

    def get(self, timeout_s: float) -> EventChunk | None:
        """Take the oldest chunk, ``None`` when none comes within ``timeout_s`` or after ``close``.

        Raises
        ------
        DeviceError
            What ``fail`` was told.
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

    def _begin_anew(self) -> None:
        self._odd = b""
        self._gap = False
        self._restarted = True
        self.restarts += 1

    def _lose(self) -> None:
        # A gap right before a restart is none: nothing of the new stream is missing.
        if not self._gap and not self._restarted:
            self._gap = True
            self.gaps += 1
