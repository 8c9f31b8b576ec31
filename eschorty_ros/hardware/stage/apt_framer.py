"""APT frames out of a byte stream that has neither checksum nor sync byte."""

from __future__ import annotations

from eschorty_ros.hardware.stage.apt_messages import HEADER_BYTES, Frame, frame_bytes, parse

_PATIENCE_NS = 50_000_000


class AptFramer:
    """Strict framer: known identifier, its exact length, for the host, from a known source.

    What is no frame is skipped byte by byte until one begins again. A frame that is not whole
    50 ms after its last byte has lost some: it is given up the same way.

    Attributes
    ----------
    frames, skipped_bytes, broken_frames : int
        Frames handed out, bytes that belonged to none, frames given up for missing bytes.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.skipped_bytes = 0
        self.broken_frames = 0
        self._buffer = bytearray()
        self._last_ns = 0

    def feed(self, data: bytes, now_ns: int) -> list[Frame]:
        """Frames that are whole with ``data``, which arrived at ``now_ns``; may be empty."""
        frames: list[Frame] = []
        if self._buffer and now_ns - self._last_ns > _PATIENCE_NS:
            self.broken_frames += 1
            self._skip()
            self._take(frames)
        if data:
            self._last_ns = now_ns
            self._buffer += data
            self._take(frames)
        return frames

    def reset(self) -> None:
        """Forget what is not whole."""
        self.skipped_bytes += len(self._buffer)
        self._buffer.clear()

    def _take(self, frames: list[Frame]) -> None:
        buffer = self._buffer
        while len(buffer) >= HEADER_BYTES:
            size = frame_bytes(bytes(buffer[:HEADER_BYTES]))
            if size == 0:
                self._skip()
            elif len(buffer) < size:
                return
            else:
                frames.append(parse(bytes(buffer[:size])))
                self.frames += 1
                del buffer[:size]

    def _skip(self) -> None:
        self.skipped_bytes += 1
        del self._buffer[0]
