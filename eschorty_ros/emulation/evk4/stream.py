"""The data stream of the EVK4: the sensor's words in packets of a set period."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import words as w3

Words = NDArray[np.uint16]


class SensorSource(Protocol):
    """The source of the pixels' words; thread-safe.

    ``start`` and ``stop`` come from the control thread while ``read`` may be waiting.
    """

    def start(self) -> None:
        """Start; sensor time is 0."""

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """Return new EVT3 words, ``b""`` when none came in ``timeout_s``."""

    def stop(self) -> None:
        """Stop."""


class Packetiser:
    """Cuts a word stream where sensor time passes a multiple of the packet period."""

    def __init__(self) -> None:
        self._pending: list[Words] = []
        self._high = 0
        self._frame = -1

    def push(self, data: bytes, period_us: int) -> list[bytes]:
        """Add words; returns the packets that they complete."""
        words = np.frombuffer(data, np.dtype("<u2"))
        cuts = self._cuts(words, period_us)
        packets, begin = [], 0
        for cut in cuts:
            packets.append(self._finish(words[begin:cut]))
            begin = cut
        if begin < len(words):
            self._pending.append(words[begin:])
        return [packet for packet in packets if packet]

    def flush(self) -> bytes:
        """Return the incomplete packet."""
        return self._finish(np.zeros(0, np.uint16))

    def _finish(self, last: Words) -> bytes:
        parts, self._pending = [*self._pending, last], []
        return b"".join(part.tobytes() for part in parts)

    def _cuts(self, words: Words, period_us: int) -> list[int]:
        kinds = words >> 12
        at = np.flatnonzero((kinds == w3.TIME_LOW) | (kinds == w3.TIME_HIGH))
        if not len(at):
            return []
        payload = (words[at] & 0xFFF).astype(np.int64)
        is_high = kinds[at] == w3.TIME_HIGH
        last_high = np.maximum.accumulate(np.where(is_high, np.arange(len(at)), -1))
        high = np.where(last_high >= 0, payload[last_high], self._high)
        self._high = int(high[-1])
        # A TIME_HIGH alone gives no time: it is repeated within its 4096 us.
        frames = ((high << 12) | payload)[~is_high] // period_us
        if not len(frames):
            return []
        changed = np.flatnonzero(np.diff(frames, prepend=self._frame))
        self._frame = int(frames[-1])
        return [int(cut) for cut in self._before_high(kinds, at[~is_high][changed])]

    @staticmethod
    def _before_high(kinds: NDArray[np.integer], cuts: NDArray[np.intp]) -> NDArray[np.intp]:
        """Keep a TIME_HIGH with the TIME_LOW that follows it."""
        follows = (cuts > 0) & (kinds[cuts - 1] == w3.TIME_HIGH)
        return cuts - follows


def without_triggers(data: bytes) -> bytes:
    """Return the words without trigger words."""
    words = np.frombuffer(data, np.dtype("<u2"))
    return words[words >> 12 != w3.EXT_TRIGGER].tobytes()


def dropped(words: int) -> bytes:
    """Return the sensor's mark for that many dropped words."""
    count = min(words, (1 << 28) - 1)
    mark = (
        w3.OTHERS << 12 | w3.DROPPED_EVENTS,
        w3.CONTINUED_12 << 12 | count & 0xFFF,
        w3.CONTINUED_12 << 12 | count >> 12 & 0xFFF,
        w3.CONTINUED_4 << 12 | count >> 24,
    )
    return np.array(mark, np.dtype("<u2")).tobytes()
