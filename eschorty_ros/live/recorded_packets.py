"""A recording's byte stream cut into packets like those of a camera node."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.live.packet_cutting import SIZE_MAX_BYTES

_PIECE_BYTES = 16_384
_PACKET_SPAN_US = 10_000


@dataclass(frozen=True, slots=True)
class TimedPacket:
    """Bytes of the stream with the sensor time (us) before and after them.

    Before them ``packets_lost`` are missing, and the laser was switched on if ``laser_on``.
    """

    data: bytes
    from_us: int
    until_us: int
    packets_lost: int
    laser_on: bool


def timed_packets(reader: RawReader, marks: NDArray[np.void]) -> Iterator[TimedPacket]:
    """Yield the stream in packets of at most 256 kB and about 10 ms; joined they are the file.

    A packet begins at each of ``marks`` (MARK_DTYPE, shape (n,)).
    """
    decoder = Decoder(reader.header.width, reader.header.height)
    pending: list[bytes] = []
    size, mark = 0, (0, False)
    from_us: int | None = None

    def packet() -> TimedPacket:
        return TimedPacket(b"".join(pending), from_us or 0, decoder.time_us or 0, *mark)

    for piece, marked in _pieces(reader, marks):
        if pending and (marked is not None or size + len(piece) > SIZE_MAX_BYTES):
            yield packet()
            pending, size, mark, from_us = [], 0, (0, False), decoder.time_us
        mark = marked or mark
        decoder.decode(piece)
        pending.append(piece)
        size += len(piece)
        now_us = decoder.time_us or 0
        from_us = now_us if from_us is None else from_us
        if now_us - from_us >= _PACKET_SPAN_US:
            yield packet()
            pending, size, mark, from_us = [], 0, (0, False), now_us
    if pending:
        yield packet()


def _pieces(
    reader: RawReader, marks: NDArray[np.void]
) -> Iterator[tuple[bytes, tuple[int, bool] | None]]:
    """Yield the stream in pieces, each with the mark at its beginning."""
    begin = 0
    for chunk in reader.chunks(_PIECE_BYTES):
        inside = (marks["byte"] >= begin) & (marks["byte"] < begin + len(chunk))
        cuts: dict[int, tuple[int, bool]] = {}
        for byte, lost, on in marks[inside].tolist():
            before, was_on = cuts.get(byte - begin, (0, False))
            cuts[byte - begin] = before + lost, was_on or bool(on)
        starts = sorted({0, *cuts})
        for start, stop in zip(starts, [*starts[1:], len(chunk)], strict=True):
            yield chunk[start:stop], cuts.get(start)
        begin += len(chunk)
