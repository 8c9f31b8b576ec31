"""APT frames out of a byte stream that has neither checksum nor sync byte."""

from __future__ import annotations

from eschorty_ros.hardware.stage.apt_messages import HEADER_BYTES, Frame, frame_bytes, parse

_TIMEOUT_NS = 50_000_000


class AptFramer:
    """Cuts bytes into frames: known identifier, its exact length, for the host, known source.

    What is no frame is skipped byte by byte up to the next one, and so is a frame that is
    incomplete 50 ms after its last byte.

    Public attributes:
    - ``frames``, ``skipped_bytes``, ``broken_frames``: Frames returned, bytes that belonged to
      none, incomplete frames.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.skipped_bytes = 0
        self.broken_frames = 0
        self._buffer = bytearray()
        self._last_ns = 0

    def feed(self, data: bytes, now_ns: int) -> list[Frame]:
        """Return the frames that ``data``, received at ``now_ns`` and maybe empty, completes."""
        frames: list[Frame] = []
        if self._buffer and now_ns - self._last_ns > _TIMEOUT_NS:
            self.broken_frames += 1
            self._skip()
            self._cut(frames)
        if data:
            self._last_ns = now_ns
            self._buffer += data
            self._cut(frames)
        return frames

    def _cut(self, frames: list[Frame]) -> None:
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
