"""A serial line in emulated time: when bytes get there, and what happens to them on the way."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable

BYTE_NS = 86_806
"""Ten bits at 115200 baud."""


class Wire:
    """One direction of a serial line; bytes leave in order, one after the other.

    Parameters
    ----------
    byte_ns : int
        Time one byte takes.
    late_ns : callable, optional
        Extra delay of what is put on the line together, on top of the line's own time.
    """

    def __init__(self, byte_ns: int = BYTE_NS, late_ns: Callable[[], int] | None = None) -> None:
        self._byte_ns = byte_ns
        self._late_ns = late_ns or (lambda: 0)
        self._free_ns = 0
        self._delivered_ns = 0
        self._flying: deque[tuple[int, bytes]] = deque()

    def put(self, data: bytes, at_ns: int) -> None:
        """Begin to send ``data`` at ``at_ns`` or when the line is free."""
        self._free_ns = max(self._free_ns, at_ns) + len(data) * self._byte_ns
        self._delivered_ns = max(self._delivered_ns, self._free_ns + self._late_ns())
        self._flying.append((self._delivered_ns, data))

    def take(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Take what has arrived by ``now_ns``: time and bytes, in order."""
        arrived = []
        while self._flying and self._flying[0][0] <= now_ns:
            arrived.append(self._flying.popleft())
        return arrived

    @property
    def next_ns(self) -> int | None:
        """Time of the next arrival."""
        return self._flying[0][0] if self._flying else None

    def clear(self) -> None:
        """Lose everything on the line."""
        self._flying.clear()


class Disturbance:
    """What can happen to the controller's bytes; every count is used up as it happens.

    Attributes
    ----------
    garbage : bytes
        Goes out between two frames, once.
    lost_bytes : int
        Bytes still to be cut out of the stream.
    loss_share : float
        Share of the frames that lose one byte.
    flips : int
        Frames still to get one bit of their payload flipped.
    flip_bit : int or None
        Which bit of the payload; ``None`` draws one.
    repeats : int
        Frames still to be sent twice.
    """

    def __init__(self, seed: int = 0) -> None:
        self.garbage = b""
        self.lost_bytes = 0
        self.loss_share = 0.0
        self.flips = 0
        self.flip_bit: int | None = None
        self.repeats = 0
        self._chance = random.Random(seed)

    def apply(self, frame: bytes) -> bytes:
        """Bytes that leave instead of ``frame``."""
        sent = bytearray(frame)
        if self.flips and len(sent) > 6:
            self.flips -= 1
            bit = self.flip_bit
            if bit is None:
                bit = self._chance.randrange(8 * (len(sent) - 6))
            sent[6 + bit // 8] ^= 1 << bit % 8
        if self.lost_bytes:
            cut = min(self.lost_bytes, len(sent))
            self.lost_bytes -= cut
            del sent[:cut]
        elif self.loss_share and self._chance.random() < self.loss_share:
            del sent[self._chance.randrange(len(sent))]
        if self.repeats:
            self.repeats -= 1
            sent += bytes(sent)
        before, self.garbage = self.garbage, b""
        return before + bytes(sent)
