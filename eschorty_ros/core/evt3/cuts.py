"""Where a stream of words can be cut: the decoder's state there, without decoding what is before.

A fast pass counts the events of blocks of words and follows TIME_HIGH and VECT_BASE_X; only the
words just before the cut are decoded. The state is that of a stream without faults: compare it with
the true one (`Decoder.is_at`) when that is known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import entry_kernel, kernel, record
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3.decoder import Decoder
from eschorty_ros.core.evt3.events import Triggers
from eschorty_ros.core.evt3.state_machine import (
    _FOREVER_US,
    _NO_ROW,
    _RUNNING,
    _bounds,
    _keep,
    decode_into,
)

BLOCK = 4096
# Words decoded before a block, which hold the current row and time.
_LEAD = 4 * BLOCK
_BASE_LEAD = 256
# A word's payload is in the low bits of a lane, its place in the block above.
_PAYLOAD = np.uint32(0xFFF)
_PLACE = np.uint32(12)


class Cut(NamedTuple):
    """A cut before word ``word``, whose event is the first after edge number ``edge - 1``."""

    word: np.int64 | int
    edge: int


def next_cut(
    words: NDArray[np.uint16],
    cut: Cut,
    edges_us: NDArray[np.int64],
    events: int,
    through: bool,
    decoder: Decoder,
) -> Cut | None:
    """Return the first cut at an edge that at least ``events`` events lie before, from ``cut`` on.

    ``None`` where there is none, or without ``through`` a trigger is before it. ``decoder`` is at
    ``cut``; its state becomes that of the cut returned, its counts have no meaning.
    """
    found = Cut(*_find(words, *cut, edges_us, events, through, decoder.memory, _passed()))
    return None if found.word < 0 else found


def pass_over(words: NDArray[np.uint16], until_us: int, decoder: Decoder) -> int:
    """Decode ``words`` without their events; return the number of words read.

    It ends before the first event at ``until_us`` or later, and before a trigger.
    """
    return int(_pass_words_over(words, until_us, False, decoder.memory, _passed())[0])


def triggers_of(words: NDArray[np.uint16], decoder: Decoder) -> tuple[Triggers, int]:
    """Decode ``words`` without their events; return the triggers and the newest event's time."""
    decoder.make_room(int(_bounds(words)[1]))
    passed = _passed()
    _, m = _pass_words_over(words, _FOREVER_US, True, decoder.memory, passed)
    t_us, channel, edge = decoder.memory.triggers
    return Triggers(t_us[:m], channel[:m], edge[:m]), int(passed["newest_us"])


class _Block(NamedTuple):
    """Events of a block, and place and payload of its last TIME_HIGH and VECT_BASE_X.

    The last two are 0 where there is none, else 1 more than the place, shifted, plus the payload.
    """

    events: np.int64
    high: np.uint32
    base: np.uint32


def _passed() -> Any:
    """Return a record of the events before the last trigger: their number and the newest's time."""
    return record("events", "newest_us")


@kernel
def _pass_over(sink, n, t_us, column, row, polarity):
    """Count an event."""
    return n + np.uint64(1)


@kernel
def _keep_within(passed, triggers, m, t_us, word, n, event_us):
    """Store a trigger where there is room, and the time of the newest event before it."""
    if n != np.uint64(passed.events):
        passed.events, passed.newest_us = n, event_us
    if m < np.uint64(triggers.t.size):
        _keep(passed, triggers, m, t_us, word, n, event_us)


_decode_over = decode_into(_pass_over, "over", _keep_within)


@entry_kernel
def _pass_words_over(words, until_us, through, memory, passed):
    """Return the numbers of words decoded and of triggers stored."""
    i, n, m = _decode_over(words, np.uint64(0), until_us, through, memory, passed)
    if n != np.uint64(passed.events):
        passed.newest_us = memory.state.floor_us
    return np.int64(i), np.int64(m)


@kernel(_nrt=False)
def _scan(words, begin, end):
    """Return the summary of the block of words begin..end - 1."""
    events, high, base = np.uint32(0), np.uint32(0), np.uint32(0)
    none = np.uint32(0)
    for i in range(begin, end):
        word = np.uint32(words[i])
        kind = np.uint32(word >> np.uint32(12))
        bits = np.uint32(word & _PAYLOAD) if kind == w3.VECT_12 else none
        bits = np.uint32(word & np.uint32(0xFF)) if kind == w3.VECT_8 else bits
        bits = np.uint32(1) if kind == w3.ADDR_X else bits
        bits = np.uint32(bits - ((bits >> np.uint32(1)) & np.uint32(0x555)))
        bits = np.uint32((bits & np.uint32(0x333)) + ((bits >> np.uint32(2)) & np.uint32(0x333)))
        bits = np.uint32((bits + (bits >> np.uint32(4)) + (bits >> np.uint32(8))) & np.uint32(0xF))
        events = np.uint32(events + bits)
        place = np.uint32(np.uint32(i - begin + np.uintp(1)) << _PLACE)
        here = np.uint32(place | (word & _PAYLOAD))
        high = max(high, here if kind == w3.TIME_HIGH else none)
        base = max(base, here if kind == w3.VECT_BASE_X else none)
    return _Block(np.int64(events), high, base)


@entry_kernel
def _find(words, word, edge, edges_us, events, through, memory, passed):
    """Advance the decoder to the next cut after ``events`` events; return it, -1 for none.

    ``memory`` is the decoder's at ``word``, the beginning of the open window.
    """
    s, size = memory.state, np.uintp(words.size)
    at, total = np.uintp(word), np.int64(0)
    base_at, has_base = at, False
    high = s.high
    # Epoch and TIME_HIGH at the block's beginning and some blocks before it.
    lead = _LEAD // BLOCK
    epochs, highs = np.full(lead + 1, s.epoch_us), np.full(lead + 1, high)
    blocks = 0
    while at + np.uintp(BLOCK) <= size:
        block = _scan(words, at, at + np.uintp(BLOCK))
        if total + block.events >= events:
            break
        total += block.events
        if block.base > 0:
            base_at = at + np.uintp((block.base >> _PLACE) - np.uint32(1))
            has_base = True
        k = blocks % (lead + 1)
        epoch_us, high = epochs[k], highs[k]
        if block.high > 0:
            step = (np.int64(block.high & _PAYLOAD) - high) & 4095
            if step < 2048:
                epoch_us += step << 12
                high = np.int64(block.high & _PAYLOAD)
        blocks += 1
        k = blocks % (lead + 1)
        epochs[k], highs[k] = epoch_us, high
        at += np.uintp(BLOCK)
    if at + np.uintp(BLOCK) > size:
        return np.int64(-1), edge
    none = np.uint64(0)
    if blocks > lead:
        begin = at - np.uintp(_LEAD)
        if has_base and base_at < begin:
            near = words[base_at : base_at + np.uintp(_BASE_LEAD)]
            _decode_over(near, none, _FOREVER_US, through, memory, passed)
        k = (blocks - lead) % (lead + 1)
        s.run, s.epoch_us, s.high, s.low, s.held_high = _RUNNING, epochs[k], highs[k], 0, -1
        s.t_us, s.floor_us = epochs[k], epochs[k]
        s.row, s.limit, s.triple, s.others_parts = _NO_ROW, 0, 0, 0
    else:
        begin = np.uintp(word)
    i, _, _ = _decode_over(words[:at], np.uint64(begin), _FOREVER_US, through, memory, passed)
    if i < np.uint64(at):
        return np.int64(-1), edge
    while edge < edges_us.size:
        if edges_us[edge] > s.floor_us:
            i, n, _ = _decode_over(words, i, edges_us[edge], through, memory, passed)
            total += np.int64(n)
            if i == np.uint64(size) or words[i] >> 12 == w3.EXT_TRIGGER:
                break
            if total >= events:
                return np.int64(i), edge + 1
        edge += 1
    return np.int64(-1), edge
