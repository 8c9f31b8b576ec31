"""A recording's byte stream cut into packets like those of a camera node."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.live.packet_cutting import SIZE_MAX_BYTES

_PIECE_BYTES = 16_384
_PACKET_SPAN_US = 10_000


@dataclass(frozen=True, slots=True)
class TimedPacket:
    """Bytes of the stream with the sensor time (us) before and after them."""

    data: bytes
    from_us: int
    until_us: int


def timed_packets(reader: RawReader) -> Iterator[TimedPacket]:
    """Yield the stream in packets of at most 256 kB and about 10 ms; joined they are the file."""
    decoder = Decoder(reader.header.width, reader.header.height)
    pending: list[bytes] = []
    size = 0
    from_us: int | None = None
    for piece in reader.chunks(_PIECE_BYTES):
        if size + len(piece) > SIZE_MAX_BYTES:
            assert from_us is not None
            yield TimedPacket(b"".join(pending), from_us, decoder.time_us or 0)
            pending, size, from_us = [], 0, decoder.time_us
        decoder.decode(piece)
        pending.append(piece)
        size += len(piece)
        now_us = decoder.time_us or 0
        from_us = now_us if from_us is None else from_us
        if now_us - from_us >= _PACKET_SPAN_US:
            yield TimedPacket(b"".join(pending), from_us, now_us)
            pending, size, from_us = [], 0, now_us
    if pending:
        yield TimedPacket(b"".join(pending), from_us or 0, decoder.time_us or 0)
