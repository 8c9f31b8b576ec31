"""A serial line in emulated time: arrival times of bytes, and their disturbances."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable

BYTE_NS = 86_806
"""Ten bits at 115200 baud."""


class Wire:
    """One direction of a serial line; bytes leave in order, one after the other.

    - ``late_ns``: Extra delay of each write, on top of the line's own time.
    """

    def __init__(self, late_ns: Callable[[], int] | None = None) -> None:
        self._late_ns = late_ns or (lambda: 0)
        self._free_ns = 0
        self._delivered_ns = 0
        self._sent: deque[tuple[int, bytes]] = deque()

    def __bool__(self) -> bool:
        return bool(self._sent)

    def send(self, data: bytes, at_ns: int) -> None:
        """Begin to send ``data`` at ``at_ns`` or when the line is free."""
        self._free_ns = max(self._free_ns, at_ns) + len(data) * BYTE_NS
        self._delivered_ns = max(self._delivered_ns, self._free_ns + self._late_ns())
        self._sent.append((self._delivered_ns, data))

    def receive(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Return the data that has arrived by ``now_ns``: time and bytes, in order."""
        arrived = []
        while self._sent and self._sent[0][0] <= now_ns:
            arrived.append(self._sent.popleft())
        return arrived


class Disturbance:
    """Faults of the controller's bytes; every count falls as its fault happens.

    Public attributes:
    - ``garbage``: Sent between two frames, once.
    - ``loss_share``: Share of the frames that lose one byte.
    - ``flips``: Frames still to get one bit of their payload flipped.
    - ``flip_bit``: Index of that bit in the payload; ``None`` for a random one.
    - ``repeats``: Frames still to be sent twice.
    """

    def __init__(self, seed: int) -> None:
        self.garbage = b""
        self.loss_share = 0.0
        self.flips = 0
        self.flip_bit: int | None = None
        self.repeats = 0
        self._chance = random.Random(seed)

    def apply(self, frame: bytes) -> bytes:
        """Return the bytes that leave instead of ``frame``."""
        sent = bytearray(frame)
        if self.flips and len(sent) > 6:
            self.flips -= 1
            bit = self.flip_bit
            if bit is None:
                bit = self._chance.randrange(8 * (len(sent) - 6))
            sent[6 + bit // 8] ^= 1 << bit % 8
        if self.loss_share and self._chance.random() < self.loss_share:
            del sent[self._chance.randrange(len(sent))]
        if self.repeats:
            self.repeats -= 1
            sent += bytes(sent)
        before, self.garbage = self.garbage, b""
        return before + bytes(sent)
