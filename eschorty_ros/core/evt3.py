"""EVT3, the event camera's wire format: streaming decoder and encoder.

Source: Prophesee's public EVT 3.0 format description; word types and counters in
``_evt3_words``. Time is int64 microseconds of the sensor's clock, first 24-bit wrap = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core import _evt3_words as w3
from eschorty_ros.core._checks import octets, whole
from eschorty_ros.core._evt3_decode import _decode
from eschorty_ros.core._evt3_encode import Encoder, sort_readout
from eschorty_ros.core._evt3_rare import _bounds
from eschorty_ros.core._evt3_words import Counters

__all__ = [
    "EVENT_DTYPE",
    "Counters",
    "Decoder",
    "Encoder",
    "Events",
    "Triggers",
    "event_arrays",
    "sort_readout",
]

EVENT_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""One event, packed: time (us), column, row, polarity (1 = brighter)."""

Bytes: TypeAlias = "bytes | bytearray | memoryview | NDArray[np.uint8]"

_WORST_CASE_WORDS = 1 << 17
"""Inputs up to this many words get buffers for the worst case; larger ones are counted first."""

_MAX_SIZE = 2048
"""Addresses have 11 bits."""


@dataclass(frozen=True, slots=True)
class Triggers:
    """External trigger edges: ``t`` int64 us, ``channel`` uint8, ``edge`` uint8 (1 = rising)."""

    t: NDArray[np.int64]
    channel: NDArray[np.uint8]
    edge: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True, slots=True)
class Events:
    """Events in stream order; the arrays are views that hold until the maker's next call.

    ``t`` int64 us (never falls), ``x`` uint16 column, ``y`` uint16 row, ``p`` uint8 polarity.
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]
    triggers: Triggers

    def __len__(self) -> int:
        return len(self.t)

    def packed(self) -> NDArray[np.void]:
        """Copy as one array of ``EVENT_DTYPE``."""
        records = np.empty(len(self.t), dtype=EVENT_DTYPE)
        records["t"], records["x"], records["y"], records["p"] = self.t, self.x, self.y, self.p
        return records


class Decoder:
    """Streaming EVT3 decoder; bytes may be cut anywhere between calls.

    Parameters
    ----------
    width, height : int
        Sensor size in pixels, 1 to 2048. Events outside are dropped and counted.

    Raises
    ------
    ArgumentError
        When a size lies outside its range.

    Notes
    -----
    A TIME_HIGH that changed zeroes the low bits, a repeated one keeps them. A step back by more
    than half the range is a wrap; time never falls. A forward jump of more than 0.4 s counts
    only when the next TIME_HIGH confirms it. Nothing is emitted before the first TIME_HIGH.
    """

    def __init__(self, width: int = 1280, height: int = 720) -> None:
        for name, size in (("width", width), ("height", height)):
            whole(name, size, 1, _MAX_SIZE)
        self.width = int(width)
        self.height = int(height)
        self._events = event_arrays(0)
        self._triggers = _trigger_buffers(0)
        self.reset()

    def reset(self) -> None:
        """Forget everything, counters too."""
        self._state = w3.initial_state()
        self._counts = np.zeros(len(w3.COUNTER_NAMES), dtype=np.int64)
        self._odd = b""

    def note_gap(self) -> None:
        """Call after lost bytes: keeps the epoch, drops row and vector base.

        The first TIME_HIGH that follows is accepted at once; what comes before it is dropped.
        """
        state = self._state
        if state[w3.S_RUN] == w3.RUN_ON:
            state[w3.S_RUN] = w3.RUN_GAP
        state[w3.S_HELD] = -1
        state[w3.S_Y] = w3.NO_Y
        state[w3.S_LIMIT] = 0
        state[w3.S_BASE] = w3.NO_BASE
        state[w3.S_PHASE] = 0
        state[w3.S_OTHERS] = 0
        self._odd = b""
        self._counts[w3.C_GAPS] += 1

    @property
    def counters(self) -> Counters:
        """Snapshot of the counts since construction or ``reset``."""
        counts = dict(zip(w3.COUNTER_NAMES, self._counts.tolist(), strict=True))
        counts["odd_byte"] = len(self._odd)
        return Counters(**counts)

    @property
    def time_us(self) -> int | None:
        """Newest sensor time seen, also without events; ``None`` before the first TIME_HIGH."""
        if self._state[w3.S_RUN] == w3.RUN_START:
            return None
        return int(self._state[w3.S_T_US])

    @property
    def settled_us(self) -> int | None:
        """Time before which nothing comes any more; ``None`` before the first TIME_HIGH.

        Earlier than ``time_us`` as long as the sensor may still take a TIME_LOW back.
        """
        if self._state[w3.S_RUN] == w3.RUN_START:
            return None
        return int(max(self._state[w3.S_FLOOR_US], self._state[w3.S_EPOCH_US]))

    def decode(self, data: Bytes) -> Events:
        """Events and triggers of the next bytes of the stream.

        Parameters
        ----------
        data : bytes-like
            Any length, odd ones included; pieces around 128 KiB are fastest.

        Returns
        -------
        Events
            Views of reused buffers, valid until the next call.
        """
        words = self._words(data)
        if words.size <= _WORST_CASE_WORDS:
            events, triggers = w3.WORST_EVENTS_PER_WORD * words.size, words.size
        else:
            events, triggers = (int(bound) for bound in _bounds(words))
        if len(self._events[0]) < events:
            self._events = event_arrays(events)
        if len(self._triggers[0]) < triggers:
            self._triggers = _trigger_buffers(triggers)
        n, m = _decode(
            words, self.width, self.height, self._state, self._counts, self._events, self._triggers
        )
        t, x, y, p = self._events
        trigger_t, channel, edge = self._triggers
        return Events(t[:n], x[:n], y[:n], p[:n], Triggers(trigger_t[:m], channel[:m], edge[:m]))

    def _words(self, data: Bytes) -> NDArray[np.uint16]:
        """Whole words of the carried byte and ``data``; an odd last byte is carried on."""
        stream = np.frombuffer(octets("data", data), dtype=np.uint8)
        if self._odd:
            stream = np.frombuffer(self._odd + stream.tobytes(), dtype=np.uint8)
        even = stream.size & ~1
        self._odd = stream[even:].tobytes()
        words = stream[:even].view("<u2")
        return words if words.flags.aligned else words.copy()


def event_arrays(
    size: int,
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Uninitialised t, x, y, p of ``size`` events."""
    whole("size", size, 0, 1 << 32)
    return (
        np.empty(size, dtype=np.int64),
        np.empty(size, dtype=np.uint16),
        np.empty(size, dtype=np.uint16),
        np.empty(size, dtype=np.uint8),
    )


def _trigger_buffers(size: int) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.uint8]]:
    return (
        np.empty(size, dtype=np.int64),
        np.empty(size, dtype=np.uint8),
        np.empty(size, dtype=np.uint8),
    )
