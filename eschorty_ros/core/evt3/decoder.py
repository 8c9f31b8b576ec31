"""Streaming EVT3 decoder: bytes in, event arrays out."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import byte_view
from eschorty_ros.core.base.boxed import Boxed
from eschorty_ros.core.base.kernel import record
from eschorty_ros.core.base.numbers import integer
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3.counters import COUNTS, Counters
from eschorty_ros.core.evt3.events import Events, Triggers, event_arrays
from eschorty_ros.core.evt3.state_machine import (
    _AFTER_GAP,
    _NO_BASE,
    _NO_ROW,
    _NO_TIME,
    _RUNNING,
    _STATE,
    DecoderMemory,
    _bounds,
    _broken,
    _decode_events,
    _trigger_arrays,
)

Bytes: TypeAlias = "bytes | bytearray | memoryview | NDArray[np.uint8]"

_WORST_CASE_WORDS = 1 << 17
"""Inputs up to this many words get buffers for the worst case; larger ones are counted first."""

_EVENTS_PER_WORD_MAX = 12


class Decoder:
    """Streaming EVT3 decoder; bytes may be cut anywhere between calls.

    >>> words = np.array([0x8000, 0x6064, 0x002A, 0x2805], "<u2")
    >>> events = Decoder().decode(words.tobytes())
    >>> events.packed().tolist()
    [(100, 5, 42, 1)]

    A TIME_HIGH that changed zeroes the low bits, a repeated one keeps them. A step back by more
    than half the range is a wrap; time never falls. A jump of more than 12 ms either way counts
    only when the next two TIME_HIGH confirm it and no word between them is broken. Nothing is
    emitted before the first TIME_HIGH.

    - ``width``, ``height``: Sensor size in pixels, 1 to 2048. Events outside are dropped and
      counted.

    Raises ``ArgumentError`` when a size is outside its range.
    """

    def __init__(self, width: int = 1280, height: int = 720) -> None:
        self.width = integer("width", width, 1, w3.ADDRESSES)
        self.height = integer("height", height, 1, w3.ADDRESSES)
        self._events = event_arrays(0)
        self._numbers = np.zeros(len(_STATE) + len(COUNTS), np.int64)
        self._state = record(*_STATE, numbers=self._numbers[: len(_STATE)])
        self._counts = record(*COUNTS, numbers=self._numbers[len(_STATE) :])
        state = self._state, self._counts, self._numbers
        self._use(DecoderMemory(self.width, self.height, *state, _trigger_arrays(0)))
        self._odd = b""
        self._drop_context()

    def _use(self, memory: DecoderMemory) -> None:
        self._memory: DecoderMemory = memory
        self._boxed: Boxed | None = None

    def note_gap(self) -> None:
        """Call after lost bytes: keeps the epoch, drops row and vector base.

        The first TIME_HIGH that follows is accepted at once; what comes before it is dropped.
        """
        if self._state["run"] == _RUNNING:
            self._state["run"] = _AFTER_GAP
        self._drop_context()
        self._odd = b""
        self._counts["gaps"] += 1

    def _drop_context(self) -> None:
        state = self._state
        state["held_high"] = -1
        state["row"] = _NO_ROW
        state["limit"] = 0
        state["base"] = _NO_BASE
        state["triple"] = 0
        state["others_parts"] = 0

    @property
    def counters(self) -> Counters:
        """Counts since construction."""
        counts = dict(zip(COUNTS, self._counts.item(), strict=True))
        counts["odd_byte"] = len(self._odd)
        return Counters(**counts)

    @property
    def time_us(self) -> int | None:
        """Newest sensor time, also without events; ``None`` before the first TIME_HIGH."""
        if self._state["run"] == _NO_TIME:
            return None
        return int(self._state["t_us"])

    @property
    def newest_us(self) -> int:
        """Time of the newest event or trigger."""
        return int(self._state["floor_us"])

    @property
    def settled_us(self) -> int | None:
        """Time before which no event can come any more; ``None`` before the first TIME_HIGH.

        Earlier than ``time_us`` as long as the sensor may still take a TIME_LOW back.
        """
        if self._state["run"] == _NO_TIME:
            return None
        return int(max(self._state["floor_us"], self._state["epoch_us"]))

    def decode(self, data: Bytes) -> Events:
        """Return events and triggers of the next bytes of the stream.

        They are views of reused buffers, valid until the next call.

        - ``data``: Any length, odd ones included; pieces around 128 KiB are fastest.
        """
        return self.decode_words(self.words(data))

    def decode_words(self, words: NDArray[np.uint16]) -> Events:
        """Return events and triggers of the next ``words``, as `decode` does of bytes."""
        if words.size <= _WORST_CASE_WORDS:
            events, triggers = _EVENTS_PER_WORD_MAX * words.size, words.size
        else:
            events, triggers = (int(bound) for bound in _bounds(words))
        if len(self._events.t) < events:
            self._events = event_arrays(events)
        self.make_room(triggers)
        n, m = _decode_events(words, self._memory, self._events)
        t, x, y, p = self._events
        trigger_t, channel, edge = self._memory.triggers
        return Events(t[:n], x[:n], y[:n], p[:n], Triggers(trigger_t[:m], channel[:m], edge[:m]))

    def make_room(self, triggers: int) -> None:
        """Make room for as many triggers of one pass."""
        if len(self._memory.triggers.t) < triggers:
            self._use(self._memory._replace(triggers=_trigger_arrays(triggers)))

    def copied(self) -> Decoder:
        """Return a decoder in the same state, with nothing counted."""
        copy = Decoder(self.width, self.height)
        copy.go_on_from(self)
        return copy

    def go_on_from(self, other: Decoder) -> None:
        """Take over the state of ``other``, without its counts."""
        self._numbers[: len(_STATE)] = other._numbers[: len(_STATE)]
        self._state["held_broken"] += _broken(self._counts) - _broken(other._counts)

    def add_counts(self, other: Decoder) -> None:
        """Add the counts of ``other`` and set them to 0 there."""
        broken = _broken(other._counts)
        self._numbers[len(_STATE) :] += other._numbers[len(_STATE) :]
        other._numbers[len(_STATE) :] = 0
        self._state["held_broken"] += broken
        other._state["held_broken"] -= broken

    def is_at(self, other: Decoder) -> bool:
        """Return whether the state is that of ``other``, as far as it matters for what follows."""
        if self._state["held_high"] >= 0:
            return False
        last = "held_confirmed" if self._state["others_parts"] else "others_type"
        size = _STATE.index(last)
        return bool(np.array_equal(self._numbers[:size], other._numbers[:size]))

    @property
    def memory(self) -> DecoderMemory:
        """State and counters, for a kernel that `decode_into` returns."""
        return self._memory

    @property
    def boxed(self) -> Boxed:
        """The memory as one argument."""
        if self._boxed is None:
            self._boxed = Boxed(self._memory)
        return self._boxed

    def words(self, data: Bytes) -> NDArray[np.uint16]:
        """Return the words of the carried byte and ``data``; an odd last byte is carried on."""
        stream = np.frombuffer(byte_view("data", data), dtype=np.uint8)
        if self._odd:
            stream = np.frombuffer(self._odd + stream.tobytes(), dtype=np.uint8)
        even = stream.size & ~1
        self._odd = stream[even:].tobytes()
        words = stream[:even].view("<u2")
        if not words.flags.aligned:
            words = words.copy()
        # One type of array for kernels, whatever the bytes are in.
        words.flags.writeable = False
        return words
