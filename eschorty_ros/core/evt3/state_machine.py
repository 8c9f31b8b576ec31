"""The state machine over the 16-bit words of EVT3, compiled for what takes the events.

The frequent words (ADDR_Y, ADDR_X, complete vector triples, TIME_LOW) are handled in the loop of
``_decode``, all others in small functions. Each event goes to a sink by a kernel ``_emit(sink, n,
t_us, column, row, polarity)``, which takes event number ``n`` and returns ``n + 1``, each trigger
by a kernel ``_keep``. `decode_into` compiles the state machine for such kernels; those of `Decoder`
store events and triggers in arrays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import int64, typeof, types, uint8, uint16, uint64
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import entry_kernel, kernel, record, with_names
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3._bits import ctz64, popcount64
from eschorty_ros.core.evt3.counters import COUNTS
from eschorty_ros.core.evt3.events import EVENT_ARRAYS

_TIME_HIGH_STEP_MAX = 3
"""Largest step of TIME_HIGH (4096 us each) taken without others confirming it.

A sensor sends every step. A flipped bit puts time off by this much at most.
"""

_CONFIRMING_STEP_MAX = 25
"""Largest step between TIME_HIGH words that confirm each other."""

_CONFIRMATIONS = 2
"""TIME_HIGH words that confirm a larger step: of random bytes one in 160 confirms another."""

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
    "floor_us",  # time of the newest event or trigger; time never falls below it
    "row",
    "limit",  # sensor width while the row is valid, else 0: one comparison checks both
    "base",  # column of the next vector's first bit
    "polarity",  # of vectors
    "triple",  # words of the current VECT_12 VECT_12 VECT_8 that have come
    "others_parts",  # words of the current OTHERS F F 7 that have come
    "others_type",
    "others_payload",
    "late",  # _IN_TIME; _LATE while the time is past the last to decode, _STOPPED at an event
    "held_confirmed",  # words that have confirmed ``held_high``
    "held_broken",  # broken words counted before it
)
_IN_TIME, _LATE, _STOPPED = range(3)
_FOREVER_US = 1 << 62


class _TriggerArrays(NamedTuple):
    t: NDArray[np.int64]
    channel: NDArray[np.uint8]
    edge: NDArray[np.uint8]


class DecoderMemory(NamedTuple):
    """What a decoder is made of for kernels; ``numbers`` are all of ``state`` and ``counts``."""

    width: int
    height: int
    state: Any
    counts: Any
    numbers: NDArray[np.int64]
    triggers: _TriggerArrays


def _trigger_arrays(size: int) -> _TriggerArrays:
    return _TriggerArrays(
        np.empty(size, dtype=np.int64),
        np.empty(size, dtype=np.uint8),
        np.empty(size, dtype=np.uint8),
    )


_WORDS = types.Array(uint16, 1, "C", readonly=True)
_TRIGGERS = types.NamedTuple((int64[::1], uint8[::1], uint8[::1]), _TriggerArrays)
_MEMORY = types.NamedTuple(
    (int64, int64, typeof(record(*_STATE)), typeof(record(*COUNTS)), int64[::1], _TRIGGERS),
    DecoderMemory,
)


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


@entry_kernel(types.UniTuple(uint64, 2)(_WORDS))
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
def _skip_to_time(words, i, c):
    """Return the index of the first TIME_HIGH from ``i`` on; count what is before it."""
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


@entry_kernel
def _broken(c):
    """Return the number of words that no sensor sends where they are."""
    return c.unknown_words + c.legacy_y_words + c.broken_triples + c.broken_continuations


@kernel
def _hold(s, c, q):
    """Hold TIME_HIGH ``q`` for those that follow to confirm it."""
    s.held_high = q
    s.held_confirmed = 0
    s.held_broken = _broken(c)
    s.low = 0


@kernel
def _confirms(s, c, q):
    """Return whether TIME_HIGH ``q`` confirms the one held: near after it, nothing broken since."""
    near = ((q - s.held_high) & 4095) <= _CONFIRMING_STEP_MAX
    return s.held_high >= 0 and near and _broken(c) == s.held_broken


@kernel
def _time_high(s, c, q, floor):
    """Apply TIME_HIGH ``q``; return the new current time, never below ``floor``.

    A word that steps back by up to 12 ms (events out of order) is followed with time held. One
    that is further off waits in ``held_high`` for the next ones to confirm it: an outlier would
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
    if step > _TIME_HIGH_STEP_MAX and _confirms(s, c, q):
        low = s.low if q == s.held_high else 0
        s.held_high = q
        s.held_confirmed += 1
        if s.held_confirmed == _CONFIRMATIONS:
            _jump(s, c, q)
            s.held_high = -1
        s.low = low
        return max(floor, s.epoch_us + s.low)
    if s.held_high >= 0:
        c.time_high_dropped += 1
        s.held_high = -1
    if 0 < step <= _TIME_HIGH_STEP_MAX:
        s.epoch_us += step << 12
        s.high = q
        s.low = 0
    elif step >= 4096 - _TIME_HIGH_STEP_MAX:
        c.time_high_back += 1
        s.epoch_us -= (4096 - step) << 12
        s.high = q
        s.low = 0
    elif step > 0:
        _hold(s, c, q)
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


@kernel(_nrt=False)
def _emit(sink, n, t_us, column, row, polarity):
    """Store an event."""
    sink.t[n] = t_us
    sink.x[n] = np.uint16(column)
    sink.y[n] = np.uint16(row)
    sink.p[n] = np.uint8(polarity)
    return n + np.uint64(1)


@kernel(_nrt=False)
def _keep(sink, triggers, m, t_us, word, n, event_us):
    """Store trigger number ``m``; the last of ``n`` events was at ``event_us``."""
    triggers.t[m] = t_us
    triggers.channel[m] = np.uint8((word >> np.uint32(8)) & np.uint32(0xF))
    triggers.edge[m] = np.uint8(word & np.uint32(1))


@kernel
def _is_late(mask, bits, s):
    """Return whether a vector's first event on the sensor is too late to decode."""
    if s.late == _IN_TIME or s.base >= s.limit:
        return False
    shown = min(s.limit - s.base, np.int64(bits))
    return mask & ((np.uint64(1) << np.uint64(shown)) - np.uint64(1)) != np.uint64(0)


def _vector(mask, bits, s, c, sink, n):
    """Emit a vector of ``bits`` pixels at the base with every check; return the event count."""
    base = s.base
    dropped = np.int64(0)
    for k in range(bits):
        if mask >> np.uint64(k) & np.uint64(1):
            column = base + np.int64(k)
            if column < s.limit:
                n = _emit(sink, n, s.t_us, column, s.row, s.polarity)
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


def _triple_by_words(words, i, s, c, sink, n):
    """Emit vector words one at a time until their triple is complete, broken, cut or late.

    Returns the next word's index and the event count.
    """
    while i < np.uint64(words.size):
        word = np.uint64(words[i])
        kind = word >> np.uint64(12)
        if kind == w3.VECT_12 and s.triple < 2:
            if _is_late(word & np.uint64(0xFFF), 12, s):
                s.late = _STOPPED
                break
            n = _vector(word & np.uint64(0xFFF), np.uint64(12), s, c, sink, n)
            s.triple += 1
            i += np.uint64(1)
        elif kind == w3.VECT_8 and s.triple == 2:
            if _is_late(word & np.uint64(0xFF), 8, s):
                s.late = _STOPPED
                break
            n = _vector(word & np.uint64(0xFF), np.uint64(8), s, c, sink, n)
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


@kernel(inline="always")
def _columns_of(row, width, height):
    """Return the number of columns of a row: 0 outside the sensor."""
    return width if np.uint64(row) < np.uint64(height) else 0


@kernel(inline="always")
def _store(s, t, row, base, polarity, columns):
    """Store what the loop of ``_decode`` keeps in variables."""
    s.t_us, s.row, s.base, s.polarity, s.limit = t, row, base, polarity, columns


def _decode(words, i, until_us, through, memory, sink):
    """Decode ``words`` from ``i`` on; return the next index, the numbers of events and triggers.

    The pass stops before the first event at ``until_us`` or later, and without ``through`` before
    the first trigger.
    """
    width, height, s, c, _, triggers = memory
    end = np.uint64(words.size)
    one = np.uint64(1)
    n = np.uint64(0)
    m = np.uint64(0)
    if s.run != _RUNNING:
        i = _skip_to_time(words, i, c)
    t = s.t_us
    floor = s.floor_us
    mark = np.uint64(0)
    row = s.row
    s.late = _LATE if t >= until_us else _IN_TIME
    if i < end and s.triple > 0:
        i, n = _triple_by_words(words, i, s, c, sink, n)
        if s.late == _STOPPED:
            end = i
    if i < end and s.others_parts > 0:
        i = _continue_others(words, i, s, c)
    base = s.base
    polarity = np.uint8(s.polarity)
    # Late events take the way of those outside the sensor, so that others need no comparison.
    shown = 0 if s.late else width
    limit = _columns_of(row, shown, height)
    while i < end:
        word = np.uint32(words[i])
        kind = word >> np.uint32(12)
        i += one
        if kind == w3.ADDR_Y:
            row = np.int64(word & np.uint32(0x7FF))
            limit = shown if row < height else 0
            c.y_past_height += row >= height
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
                n = _emit(sink, n, t, x, row, (word >> np.uint32(11)) & np.uint32(1))
            else:
                limit_x = _columns_of(row, width, height)
                if x < limit_x:
                    i -= one
                    break
                _drop_x(c, row, limit_x)
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
                    n = _emit(sink, n, t, first + np.int64(ctz64(mask)), row, polarity)
                    mask &= mask - one
            else:
                _store(s, t, row, base, polarity, _columns_of(row, width, height))
                i, n = _triple_by_words(words, i - one, s, c, sink, n)
                base = s.base
                if s.late == _STOPPED:
                    break
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
            s.late = _LATE if t >= until_us else _IN_TIME
            shown = 0 if s.late else width
            limit = _columns_of(row, shown, height)
        elif kind == w3.TIME_HIGH:
            if n + m != mark:
                mark = n + m
                floor = t
            t = _time_high(s, c, np.int64(word & np.uint32(0xFFF)), floor)
            s.late = _LATE if t >= until_us else _IN_TIME
            shown = 0 if s.late else width
            limit = _columns_of(row, shown, height)
        elif kind == w3.EXT_TRIGGER:
            if not through:
                i -= one
                break
            _keep(sink, triggers, m, t, word, n, t if n + m != mark else floor)
            m += one
        elif kind == w3.VECT_8:
            # It belongs to a triple whose first words are missing.
            _store(s, t, row, base, polarity, _columns_of(row, width, height))
            mask = np.uint64(word) & np.uint64(0xFF)
            if _is_late(mask, 8, s):
                i -= one
                break
            c.broken_triples += 1
            n = _vector(mask, np.uint64(8), s, c, sink, n)
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
    _store(s, t, row, base, polarity, _columns_of(row, width, height))
    s.floor_us = t if n + m != mark else floor
    s.late = _IN_TIME
    c.events += n
    c.triggers += m
    return i, n, m


def decode_into(emit: Any, name: str, keep: Any = _keep) -> Any:
    """Return ``_decode`` compiled for these kernels; ``name`` distinguishes it from others."""
    vector = with_names(_vector, name, _emit=emit)
    triple = with_names(_triple_by_words, name, _vector=vector)
    others = {"_vector": vector, "_triple_by_words": triple}
    return with_names(_decode, name, _emit=emit, _keep=keep, **others)


_decode_stored = decode_into(_emit, "stored")


@entry_kernel(types.UniTuple(uint64, 2)(_WORDS, _MEMORY, EVENT_ARRAYS))
def _decode_events(words, memory, out):
    """Decode all ``words``; return the numbers of events and triggers written.

    ``out`` and the triggers hold at least ``_bounds(words)`` entries.
    """
    _, n, m = _decode_stored(words, np.uint64(0), _FOREVER_US, True, memory, out)
    return n, m
