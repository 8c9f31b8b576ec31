"""Streaming EVT3 decoder: one compiled state machine over the 16-bit words.

The frequent words (ADDR_Y, ADDR_X, complete vector triples, TIME_LOW) are handled in the loop of
``_decode``, all others in small functions.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple, TypeAlias

import numpy as np
from numba import int64, typeof, types, uint8, uint16, uint64
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import byte_view, integer
from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3._bits import ctz64, popcount64
from eschorty_ros.core.evt3.events import EVENT_ARRAYS, Events, Triggers, event_arrays

Bytes: TypeAlias = "bytes | bytearray | memoryview | NDArray[np.uint8]"

_WORST_CASE_WORDS = 1 << 17
"""Inputs up to this many words get buffers for the worst case; larger ones are counted first."""

_EVENTS_PER_WORD_MAX = 12

_TIME_HIGH_STEP_MAX = 3
"""Largest step of TIME_HIGH (4096 us each) taken without a second word confirming it.

A sensor sends every step. A flipped bit puts time off by this much at most.
"""

_CONFIRMING_STEP_MAX = 100
"""Largest step from a TIME_HIGH that awaits confirmation to one that confirms it."""

_NO_ROW = -1
_NO_BASE = 1 << 20

# State of the stream's time: no TIME_HIGH yet; none since a gap; known.
_NO_TIME, _AFTER_GAP, _RUNNING = range(3)


_STATE = (
    "run",  # _NO_TIME, _AFTER_GAP or _RUNNING
    "epoch_us",  # time of the last TIME_HIGH, unwrapped
    "high",  # payload of the last TIME_HIGH
    "low",  # payload of the last TIME_LOW
    "held_high",  # TIME_HIGH that awaits confirmation, -1 for none
    "t_us",  # current time
    "floor_us",  # time of the newest event; time never falls below it
    "row",
    "limit",  # sensor width while the row is valid, else 0: one comparison checks both
    "base",  # column of the next vector's first bit
    "polarity",  # of vectors
    "triple",  # words of the current VECT_12 VECT_12 VECT_8 that have come
    "others_parts",  # words of the current OTHERS F F 7 that have come
    "others_type",
    "others_payload",
)


class _TriggerArrays(NamedTuple):
    t: NDArray[np.int64]
    channel: NDArray[np.uint8]
    edge: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Counters:
    """Counts of a decoder since it was made or reset."""

    events: int = 0
    """Returned, as are ``triggers``."""
    triggers: int = 0
    events_dropped: int = 0
    """In the stream and not returned, for whatever reason; of those:"""
    events_before_time: int = 0
    """Before the first TIME_HIGH of the stream or after a known gap."""
    events_without_y: int = 0
    """Without a valid ADDR_Y, or in a row past the sensor's height."""
    events_without_base: int = 0
    """In vectors before the first VECT_BASE_X."""
    events_past_width: int = 0
    words_before_time: int = 0
    """Words of any type skipped before the first TIME_HIGH."""
    x_without_y: int = 0
    """Words that break the grammar in this way, as the next three."""
    vectors_without_base: int = 0
    vectors_past_width: int = 0
    y_past_height: int = 0
    broken_triples: int = 0
    """Incomplete sequences VECT_12 VECT_12 VECT_8."""
    broken_continuations: int = 0
    """Incomplete sequences OTHERS F F 7."""
    unknown_words: int = 0
    legacy_y_words: int = 0
    time_high_back: int = 0
    time_high_jumps: int = 0
    """Forward jumps of more than 12 ms that the next TIME_HIGH confirmed."""
    time_high_dropped: int = 0
    """Those that it did not confirm."""
    time_low_back: int = 0
    """TIME_LOW below the time of an event already returned; time was held."""
    others_words: int = 0
    sensor_dropped_time_low: int = 0
    """The sensor's reports that its saturated readout dropped words, as the next two."""
    sensor_dropped_time_high: int = 0
    sensor_dropped_events: int = 0
    erc_events_in: int = 0
    """Sum of the event counts before the sensor's event-rate controller."""
    erc_events_out: int = 0
    """And behind it."""
    gaps: int = 0
    """Calls of ``note_gap``."""
    odd_byte: int = 0
    """1 while half a word waits for its second byte."""

    @property
    def sensor_drop_words(self) -> int:
        """All words by which the sensor reported a saturated readout."""
        return (
            self.sensor_dropped_time_low
            + self.sensor_dropped_time_high
            + self.sensor_dropped_events
        )


_COUNTS = tuple(f.name for f in fields(Counters) if f.name != "odd_byte")


class Decoder:
    """Streaming EVT3 decoder; bytes may be cut anywhere between calls.

    >>> words = np.array([0x8000, 0x6064, 0x002A, 0x2805], "<u2")
    >>> events = Decoder().decode(words.tobytes())
    >>> events.packed().tolist()
    [(100, 5, 42, 1)]

    Parameters
    ----------
    width, height : int
        Sensor size in pixels, 1 to 2048. Events outside are dropped and counted.

    Raises
    ------
    ArgumentError
        When a size is outside its range.

    Notes
    -----
    A TIME_HIGH that changed zeroes the low bits, a repeated one keeps them. A step back by more
    than half the range is a wrap; time never falls. A jump of more than 12 ms either way counts
    only when the next TIME_HIGH confirms it. Nothing is emitted before the first TIME_HIGH.
    """

    def __init__(self, width: int = 1280, height: int = 720) -> None:
        for name, size in (("width", width), ("height", height)):
            integer(name, size, 1, w3.ADDRESSES)
        self.width = int(width)
        self.height = int(height)
        self._events = event_arrays(0)
        self._triggers = _trigger_arrays(0)
        self.reset()

    def reset(self) -> None:
        """Drop state and counters."""
        self._state = record(*_STATE)
        self._counts = record(*_COUNTS)
        self._odd = b""
        self._drop_context()

    def note_gap(self) -> None:
        """Call after lost bytes: keeps the epoch, drops row and vector base.

        The first TIME_HIGH that follows is accepted at once; what comes before it is dropped.
        """
        if self._state.run == _RUNNING:
            self._state.run = _AFTER_GAP
        self._drop_context()
        self._odd = b""
        self._counts.gaps += 1

    def _drop_context(self) -> None:
        state = self._state
        state.held_high = -1
        state.row = _NO_ROW
        state.limit = 0
        state.base = _NO_BASE
        state.triple = 0
        state.others_parts = 0

    @property
    def counters(self) -> Counters:
        """Counts since construction or ``reset``."""
        counts = dict(zip(_COUNTS, self._counts.item(), strict=True))
        counts["odd_byte"] = len(self._odd)
        return Counters(**counts)

    @property
    def time_us(self) -> int | None:
        """Newest sensor time, also without events; ``None`` before the first TIME_HIGH."""
        if self._state.run == _NO_TIME:
            return None
        return int(self._state.t_us)

    @property
    def settled_us(self) -> int | None:
        """Time before which no event can come any more; ``None`` before the first TIME_HIGH.

        Earlier than ``time_us`` as long as the sensor may still take a TIME_LOW back.
        """
        if self._state.run == _NO_TIME:
            return None
        return int(max(self._state.floor_us, self._state.epoch_us))

    def decode(self, data: Bytes) -> Events:
        """Return events and triggers of the next bytes of the stream.

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
            events, triggers = _EVENTS_PER_WORD_MAX * words.size, words.size
        else:
            events, triggers = (int(bound) for bound in _bounds(words))
        if len(self._events.t) < events:
            self._events = event_arrays(events)
        if len(self._triggers.t) < triggers:
            self._triggers = _trigger_arrays(triggers)
        n, m = _decode(
            words, self.width, self.height, self._state, self._counts, self._events, self._triggers
        )
        t, x, y, p = self._events
        trigger_t, channel, edge = self._triggers
        return Events(t[:n], x[:n], y[:n], p[:n], Triggers(trigger_t[:m], channel[:m], edge[:m]))

    def _words(self, data: Bytes) -> NDArray[np.uint16]:
        """Return the words of the carried byte and ``data``; an odd last byte is carried on."""
        stream = np.frombuffer(byte_view("data", data), dtype=np.uint8)
        if self._odd:
            stream = np.frombuffer(self._odd + stream.tobytes(), dtype=np.uint8)
        even = stream.size & ~1
        self._odd = stream[even:].tobytes()
        words = stream[:even].view("<u2")
        return words if words.flags.aligned else words.copy()


def _trigger_arrays(size: int) -> _TriggerArrays:
    return _TriggerArrays(
        np.empty(size, dtype=np.int64),
        np.empty(size, dtype=np.uint8),
        np.empty(size, dtype=np.uint8),
    )


_WORDS = types.Array(uint16, 1, "C", readonly=True)
_TRIGGERS = types.NamedTuple((int64[::1], uint8[::1], uint8[::1]), _TriggerArrays)


@kernel
def _event_count(word):
    """Return the number of events in a word."""
    kind = np.uint32(word) >> np.uint32(12)
    if kind == w3.ADDR_X:
        return np.uint64(1)
    if kind == w3.VECT_12:
        return popcount64(np.uint64(word) & np.uint64(0xFFF))
    if kind == w3.VECT_8:
        return popcount64(np.uint64(word) & np.uint64(0xFF))
    return np.uint64(0)


@kernel(types.UniTuple(uint64, 2)(_WORDS))
def _bounds(words):
    """Return upper bounds of the numbers of events and triggers in ``words``."""
    events = np.uint64(0)
    triggers = np.uint64(0)
    for k in range(words.size):
        word = words[np.uintp(k)]
        events += _event_count(word)
        triggers += np.uint64(word >> 12 == w3.EXT_TRIGGER)
    return events, triggers


@kernel
def _skip_to_time(words, c):
    """Return the index of the first TIME_HIGH; count the words and events before it."""
    i = np.uint64(0)
    while i < np.uint64(words.size) and words[i] >> 12 != w3.TIME_HIGH:
        lost = np.int64(_event_count(words[i]))
        c.events_before_time += lost
        c.events_dropped += lost
        c.words_before_time += 1
        i += np.uint64(1)
    return i


@kernel
def _jump(s, c, q):
    """Apply TIME_HIGH ``q`` by the half-range rule: further back than 2048 is a wrap."""
    step = q - s.high
    if step < -2048:
        step += 4096
    if step < 0:
        c.time_high_back += 1
    elif step > _TIME_HIGH_STEP_MAX:
        c.time_high_jumps += 1
    s.epoch_us += step << 12
    s.high = q
    s.low = 0


@kernel
def _time_high(s, c, q, floor):
    """Apply TIME_HIGH ``q``; return the new current time, never below ``floor``.

    A word that steps back by up to 12 ms (events out of order) is followed with time held. One
    that is further off waits in ``held_high`` for the next to confirm it: a lone outlier would
    otherwise freeze a clamped clock until real time catches up.
    """
    if s.run != _RUNNING:
        if s.run == _NO_TIME:
            s.epoch_us = q << 12
            s.high = q
            s.low = 0
        else:
            _jump(s, c, q)
        s.run = _RUNNING
        return max(floor, s.epoch_us)
    step = (q - s.high) & 4095
    held = s.held_high
    s.held_high = -1
    if step <= _TIME_HIGH_STEP_MAX:
        if held >= 0:
            c.time_high_dropped += 1
        if step:
            s.epoch_us += step << 12
            s.high = q
            s.low = 0
    elif held >= 0 and ((q - held) & 4095) <= _CONFIRMING_STEP_MAX:
        low = s.low
        _jump(s, c, held)
        if q == held:
            s.low = low
        else:
            s.epoch_us += ((q - held) & 4095) << 12
            s.high = q
    else:
        if held >= 0:
            c.time_high_dropped += 1
        if step >= 4096 - _TIME_HIGH_STEP_MAX:
            c.time_high_back += 1
            s.epoch_us -= (4096 - step) << 12
            s.high = q
        else:
            s.held_high = q
        s.low = 0
    return max(floor, s.epoch_us + s.low)


@kernel
def _begin_others(s, c, subtype):
    c.others_words += 1
    if subtype == w3.DROPPED_TIME_LOW:
        c.sensor_dropped_time_low += 1
    elif subtype == w3.DROPPED_TIME_HIGH:
        c.sensor_dropped_time_high += 1
    elif subtype == w3.DROPPED_EVENTS:
        c.sensor_dropped_events += 1
    s.others_parts = 1
    s.others_type = subtype
    s.others_payload = 0


@kernel
def _continue_others(words, i, s, c):
    """Collect F, F, 7 of a pending OTHERS from word ``i`` on; return the next word's index."""
    while i < np.uint64(words.size) and s.others_parts > 0:
        word = np.int64(words[i])
        kind = word >> 12
        parts = s.others_parts
        if kind == w3.CONTINUED_12 and parts < 3:
            s.others_payload |= (word & 0xFFF) << (12 * (parts - 1))
            s.others_parts = parts + 1
            i += np.uint64(1)
            continue
        if kind == w3.CONTINUED_4 and parts == 3:
            s.others_payload |= (word & 0xF) << 24
            i += np.uint64(1)
        elif kind == w3.CONTINUED_12 or kind == w3.CONTINUED_4:
            # A continuation out of place is consumed here; any other word is the caller's.
            c.broken_continuations += 1
            i += np.uint64(1)
        elif parts > 1:
            c.broken_continuations += 1
        if s.others_type == w3.ERC_EVENTS_IN:
            c.erc_events_in += s.others_payload
        elif s.others_type == w3.ERC_EVENTS_OUT:
            c.erc_events_out += s.others_payload
        s.others_parts = 0
    return i


@kernel
def _vector(mask, bits, s, c, out, n):
    """Emit a vector of ``bits`` pixels at the base with every check; return the event count."""
    base = s.base
    dropped = np.int64(0)
    for k in range(bits):
        if mask >> np.uint64(k) & np.uint64(1):
            column = base + np.int64(k)
            if column < s.limit:
                out.t[n] = s.t_us
                out.x[n] = np.uint16(column)
                out.y[n] = np.uint16(s.row)
                out.p[n] = np.uint8(s.polarity)
                n += np.uint64(1)
            else:
                dropped += 1
    if base >= _NO_BASE:
        c.vectors_without_base += 1
        c.events_without_base += dropped
    elif s.limit == 0:
        if s.row == _NO_ROW:
            c.x_without_y += 1
        c.events_without_y += dropped
    elif dropped > 0:
        c.vectors_past_width += 1
        c.events_past_width += dropped
    c.events_dropped += dropped
    # Bounded, so that no stream can advance the base to _NO_BASE.
    s.base = base if base >= _NO_BASE else min(base + np.int64(bits), np.int64(4096))
    return n


@kernel
def _triple_by_words(words, i, s, c, out, n):
    """Emit vector words one at a time until their triple is complete, broken or cut.

    Returns the next word's index and the event count.
    """
    while i < np.uint64(words.size):
        word = np.uint64(words[i])
        kind = word >> np.uint64(12)
        if kind == w3.VECT_12 and s.triple < 2:
            n = _vector(word & np.uint64(0xFFF), np.uint64(12), s, c, out, n)
            s.triple += 1
            i += np.uint64(1)
        elif kind == w3.VECT_8 and s.triple == 2:
            n = _vector(word & np.uint64(0xFF), np.uint64(8), s, c, out, n)
            s.triple = 0
            i += np.uint64(1)
            break
        else:
            c.broken_triples += 1
            s.triple = 0
            break
    return i, n


@kernel
def _drop_x(c, row, limit):
    """Count an ADDR_X that gave no event."""
    c.events_dropped += 1
    if limit > 0:
        c.events_past_width += 1
        return
    if row == _NO_ROW:
        c.x_without_y += 1
    c.events_without_y += 1


@kernel(
    types.UniTuple(uint64, 2)(
        _WORDS,
        int64,
        int64,
        typeof(record(*_STATE)),
        typeof(record(*_COUNTS)),
        EVENT_ARRAYS,
        _TRIGGERS,
    )
)
def _decode(words, width, height, s, c, out, triggers):
    """Decode all ``words``; return the numbers of events and triggers written.

    ``out`` and ``triggers`` hold at least ``_bounds(words)`` entries.
    """
    t_out, x_out, y_out, p_out = out
    end = np.uint64(words.size)
    one = np.uint64(1)
    i = np.uint64(0)
    n = np.uint64(0)
    m = np.uint64(0)
    if s.run != _RUNNING:
        i = _skip_to_time(words, c)
    t = s.t_us
    floor = s.floor_us
    mark = np.uint64(0)
    row = s.row
    limit = s.limit
    if i < end and s.triple > 0:
        i, n = _triple_by_words(words, i, s, c, out, n)
    if i < end and s.others_parts > 0:
        i = _continue_others(words, i, s, c)
    base = s.base
    polarity = np.uint8(s.polarity)
    while i < end:
        word = np.uint32(words[i])
        kind = word >> np.uint32(12)
        i += one
        if kind == w3.ADDR_Y:
            row = np.int64(word & np.uint32(0x7FF))
            limit = width if row < height else 0
            if limit == 0:
                c.y_past_height += 1
            if i >= end:
                break
            # The usual successor, without another turn of the loop.
            word = np.uint32(words[i])
            kind = word >> np.uint32(12)
            if kind != w3.ADDR_X:
                continue
            i += one
        if kind == w3.ADDR_X:
            x = np.int64(word & np.uint32(0x7FF))
            if x < limit:
                t_out[n] = t
                x_out[n] = np.uint16(x)
                y_out[n] = np.uint16(row)
                p_out[n] = np.uint8((word >> np.uint32(11)) & np.uint32(1))
                n += one
            else:
                _drop_x(c, row, limit)
        elif kind == w3.VECT_12:
            if (
                i + one < end
                and words[i] >> 12 == w3.VECT_12
                and words[i + one] >> 12 == w3.VECT_8
                and base + 32 <= limit
            ):
                mask = (
                    (np.uint64(word) & np.uint64(0xFFF))
                    | (np.uint64(words[i]) & np.uint64(0xFFF)) << np.uint64(12)
                    | (np.uint64(words[i + one]) & np.uint64(0xFF)) << np.uint64(24)
                )
                i += np.uint64(2)
                first = base
                base += 32
                while mask != np.uint64(0):
                    t_out[n] = t
                    x_out[n] = np.uint16(first + np.int64(ctz64(mask)))
                    y_out[n] = np.uint16(row)
                    p_out[n] = polarity
                    n += one
                    mask &= mask - one
            else:
                s.t_us, s.row, s.limit = t, row, limit
                s.base, s.polarity = base, polarity
                i, n = _triple_by_words(words, i - one, s, c, out, n)
                base = s.base
        elif kind == w3.VECT_BASE_X:
            base = np.int64(word & np.uint32(0x7FF))
            polarity = np.uint8((word >> np.uint32(11)) & np.uint32(1))
        elif kind == w3.TIME_LOW:
            # The sensor may correct a TIME_LOW at once with a lower one: only the time of an event
            # already written may not be undercut.
            if n + m != mark:
                mark = n + m
                floor = t
            s.low = np.int64(word & np.uint32(0xFFF))
            t = s.epoch_us + s.low
            if t < floor:
                c.time_low_back += 1
                t = floor
        elif kind == w3.TIME_HIGH:
            if n + m != mark:
                mark = n + m
                floor = t
            t = _time_high(s, c, np.int64(word & np.uint32(0xFFF)), floor)
        elif kind == w3.EXT_TRIGGER:
            triggers.t[m] = t
            triggers.channel[m] = np.uint8((word >> np.uint32(8)) & np.uint32(0xF))
            triggers.edge[m] = np.uint8(word & np.uint32(1))
            m += one
        elif kind == w3.VECT_8:
            # It belongs to a triple whose first words are missing.
            c.broken_triples += 1
            s.t_us, s.row, s.limit = t, row, limit
            s.base, s.polarity = base, polarity
            n = _vector(np.uint64(word) & np.uint64(0xFF), np.uint64(8), s, c, out, n)
            base = s.base
        elif kind == w3.OTHERS:
            _begin_others(s, c, np.int64(word & np.uint32(0xFFF)))
            i = _continue_others(words, i, s, c)
        elif kind == w3.LEGACY_Y:
            c.legacy_y_words += 1
            row = np.int64(_NO_ROW)
            limit = 0
        elif kind == w3.CONTINUED_4 or kind == w3.CONTINUED_12:
            c.broken_continuations += 1
        else:
            c.unknown_words += 1
    s.t_us = t
    s.floor_us = t if n + m != mark else floor
    s.row = row
    s.limit = limit
    s.base = base
    s.polarity = polarity
    c.events += n
    c.triggers += m
    return n, m
