"""Compiled EVT3 decoding: the words off the hot path, on the state array."""

from __future__ import annotations

import numpy as np
from numba import int64, njit, types, uint8, uint16, uint64

from eschorty_ros.core import _evt3_words as w3
from eschorty_ros.core._bits import popcount64
from eschorty_ros.core._evt3_words import (
    ADDR_X,
    CONTINUED_4,
    CONTINUED_12,
    EXT_TRIGGER,
    LEGACY_Y,
    NO_BASE,
    NO_Y,
    OTHERS,
    S_BASE,
    S_EPOCH_US,
    S_HELD,
    S_HIGH,
    S_LIMIT,
    S_LOW,
    S_OTHERS,
    S_PAYLOAD,
    S_PHASE,
    S_RUN,
    S_SUBTYPE,
    S_VPOL,
    TIME_HIGH,
    TIME_HIGH_STEP_MAX,
    VECT_8,
    VECT_12,
)

WORDS = types.Array(uint16, 1, "C", readonly=True)
OUT = types.Tuple((int64[::1], uint16[::1], uint16[::1], uint8[::1]))
TRIGGERS = types.Tuple((int64[::1], uint8[::1], uint8[::1]))


@njit(types.Tuple((uint64, uint64))(WORDS), cache=True, nogil=True)
def _bounds(words):
    """Upper bounds of events and triggers in ``words``."""
    events = np.uint64(0)
    triggers = np.uint64(0)
    for k in range(words.size):
        word = np.uint32(words[np.uintp(k)])
        kind = word >> np.uint32(12)
        if kind == ADDR_X:
            events += np.uint64(1)
        elif kind == VECT_12:
            events += popcount64(np.uint64(word & np.uint32(0xFFF)))
        elif kind == VECT_8:
            events += popcount64(np.uint64(word & np.uint32(0xFF)))
        elif kind == EXT_TRIGGER:
            triggers += np.uint64(1)
    return events, triggers


@njit(uint64(WORDS, uint64, int64[::1]), cache=True, nogil=True)
def _skip_to_time(words, i, c):
    """Index of the first TIME_HIGH from ``i`` on; what lies before is counted."""
    end = np.uint64(words.size)
    while i < end:
        word = np.uint32(words[i])
        kind = word >> np.uint32(12)
        if kind == TIME_HIGH:
            break
        lost = np.int64(0)
        if kind == ADDR_X:
            lost = np.int64(1)
        elif kind == VECT_12:
            lost = np.int64(popcount64(np.uint64(word & np.uint32(0xFFF))))
        elif kind == VECT_8:
            lost = np.int64(popcount64(np.uint64(word & np.uint32(0xFF))))
        c[w3.C_EVENTS_BEFORE_TIME] += lost
        c[w3.C_EVENTS_DROPPED] += lost
        c[w3.C_WORDS_BEFORE_TIME] += 1
        i += np.uint64(1)
    return i


@njit((int64[::1], int64[::1], int64), cache=True, nogil=True)
def _jump(s, c, q):
    """Take TIME_HIGH ``q`` by the half-range rule: further back than 2048 is a wrap."""
    step = q - s[S_HIGH]
    if step < -2048:
        step += 4096
    if step < 0:
        c[w3.C_TIME_HIGH_BACK] += 1
    elif step > TIME_HIGH_STEP_MAX:
        c[w3.C_TIME_HIGH_JUMPS] += 1
    s[S_EPOCH_US] += step << 12
    s[S_HIGH] = q
    s[S_LOW] = 0


@njit(int64(int64[::1], int64[::1], int64, int64), cache=True, nogil=True)
def _time_high(s, c, q, floor):
    """Apply TIME_HIGH ``q``; returns the new current time, never below ``floor``.

    A word that steps back by up to 0.4 s (events out of order) is followed with time held. One
    that is further off waits in ``S_HELD`` for the next to confirm it: a lone outlier would
    otherwise freeze a clamped clock until real time catches up.
    """
    if s[S_RUN] != w3.RUN_ON:
        if s[S_RUN] == w3.RUN_START:
            s[S_EPOCH_US] = q << 12
            s[S_HIGH] = q
            s[S_LOW] = 0
        else:
            _jump(s, c, q)
        s[S_RUN] = w3.RUN_ON
        return max(floor, s[S_EPOCH_US])
    step = (q - s[S_HIGH]) & 4095
    held = s[S_HELD]
    s[S_HELD] = -1
    if step <= TIME_HIGH_STEP_MAX:
        if held >= 0:
            c[w3.C_TIME_HIGH_DROPPED] += 1
        if step:
            s[S_EPOCH_US] += step << 12
            s[S_HIGH] = q
            s[S_LOW] = 0
    elif held >= 0 and ((q - held) & 4095) <= TIME_HIGH_STEP_MAX:
        low = s[S_LOW]
        _jump(s, c, held)
        if q == held:
            s[S_LOW] = low
        else:
            s[S_EPOCH_US] += ((q - held) & 4095) << 12
            s[S_HIGH] = q
    else:
        if held >= 0:
            c[w3.C_TIME_HIGH_DROPPED] += 1
        if step >= 4096 - TIME_HIGH_STEP_MAX:
            c[w3.C_TIME_HIGH_BACK] += 1
            s[S_EPOCH_US] -= (4096 - step) << 12
            s[S_HIGH] = q
        else:
            s[S_HELD] = q
        s[S_LOW] = 0
    return max(floor, s[S_EPOCH_US] + s[S_LOW])


@njit((int64[::1], int64[::1]), cache=True, nogil=True)
def _others_done(s, c):
    if s[S_SUBTYPE] == w3.ERC_EVENTS_IN:
        c[w3.C_ERC_EVENTS_IN] += s[S_PAYLOAD]
    elif s[S_SUBTYPE] == w3.ERC_EVENTS_OUT:
        c[w3.C_ERC_EVENTS_OUT] += s[S_PAYLOAD]
    s[S_OTHERS] = 0


@njit((int64[::1], int64[::1], int64), cache=True, nogil=True)
def _others_begin(s, c, subtype):
    c[w3.C_OTHERS_WORDS] += 1
    if subtype == w3.DROPPED_TIME_LOW:
        c[w3.C_SENSOR_DROPPED_TIME_LOW] += 1
    elif subtype == w3.DROPPED_TIME_HIGH:
        c[w3.C_SENSOR_DROPPED_TIME_HIGH] += 1
    elif subtype == w3.DROPPED_EVENTS:
        c[w3.C_SENSOR_DROPPED_EVENTS] += 1
    s[S_OTHERS] = 1
    s[S_SUBTYPE] = subtype
    s[S_PAYLOAD] = 0


@njit(uint64(WORDS, uint64, int64[::1], int64[::1]), cache=True, nogil=True)
def _others_payload(words, i, s, c):
    """Collect F, F, 7 of a pending OTHERS from word ``i`` on; returns the next word's index."""
    while i < np.uint64(words.size) and s[S_OTHERS] > 0:
        word = np.int64(words[i])
        kind = word >> 12
        parts = s[S_OTHERS]
        if kind == CONTINUED_12 and parts < 3:
            s[S_PAYLOAD] |= (word & 0xFFF) << (12 * (parts - 1))
            s[S_OTHERS] = parts + 1
            i += np.uint64(1)
        elif kind == CONTINUED_4 and parts == 3:
            s[S_PAYLOAD] |= (word & 0xF) << 24
            _others_done(s, c)
            i += np.uint64(1)
        else:
            # A continuation out of place is consumed here; any other word is the caller's.
            if kind == CONTINUED_12 or kind == CONTINUED_4:
                c[w3.C_BROKEN_CONTINUATIONS] += 1
                i += np.uint64(1)
            elif parts > 1:
                c[w3.C_BROKEN_CONTINUATIONS] += 1
            _others_done(s, c)
    return i


@njit(
    uint64(uint64, uint64, int64, int64, int64[::1], int64[::1], OUT, uint64),
    cache=True,
    nogil=True,
)
def _vector(mask, bits, t, y, s, c, out, n):
    """Emit a vector of ``bits`` pixels at ``S_BASE`` with every check; returns the event count."""
    base = s[S_BASE]
    dropped = np.int64(0)
    for k in range(bits):
        if mask >> np.uint64(k) & np.uint64(1):
            column = base + np.int64(k)
            if column < s[S_LIMIT]:
                out[0][n] = t
                out[1][n] = np.uint16(column)
                out[2][n] = np.uint16(y)
                out[3][n] = np.uint8(s[S_VPOL])
                n += np.uint64(1)
            else:
                dropped += 1
    if base >= NO_BASE:
        c[w3.C_VECTORS_WITHOUT_BASE] += 1
        c[w3.C_EVENTS_WITHOUT_BASE] += dropped
    elif s[S_LIMIT] == 0:
        if y == NO_Y:
            c[w3.C_X_WITHOUT_Y] += 1
        c[w3.C_EVENTS_WITHOUT_Y] += dropped
    elif dropped > 0:
        c[w3.C_VECTORS_PAST_WIDTH] += 1
        c[w3.C_EVENTS_PAST_WIDTH] += dropped
    c[w3.C_EVENTS_DROPPED] += dropped
    # Bounded, so that no stream can walk the base into NO_BASE.
    s[S_BASE] = base if base >= NO_BASE else min(base + np.int64(bits), np.int64(4096))
    return n


@njit(
    types.Tuple((uint64, uint64))(WORDS, uint64, int64, int64, int64[::1], int64[::1], OUT, uint64),
    cache=True,
    nogil=True,
)
def _triple_by_words(words, i, t, y, s, c, out, n):
    """Vector words one at a time until their triple is whole, broken or cut by the buffer's end."""
    while i < np.uint64(words.size):
        word = np.uint64(words[i])
        kind = word >> np.uint64(12)
        phase = s[S_PHASE]
        if kind == VECT_12 and phase < 2:
            n = _vector(word & np.uint64(0xFFF), np.uint64(12), t, y, s, c, out, n)
            s[S_PHASE] = phase + 1
            i += np.uint64(1)
        elif kind == VECT_8 and phase == 2:
            n = _vector(word & np.uint64(0xFF), np.uint64(8), t, y, s, c, out, n)
            s[S_PHASE] = 0
            i += np.uint64(1)
            break
        else:
            c[w3.C_BROKEN_TRIPLES] += 1
            s[S_PHASE] = 0
            break
    return i, n


@njit((int64[::1], int64, int64), cache=True, nogil=True)
def _drop_x(c, y, limit):
    """Count an ADDR_X that gave no event."""
    c[w3.C_EVENTS_DROPPED] += 1
    if limit == 0:
        if y == NO_Y:
            c[w3.C_X_WITHOUT_Y] += 1
        c[w3.C_EVENTS_WITHOUT_Y] += 1
    else:
        c[w3.C_EVENTS_PAST_WIDTH] += 1


@njit((int64, int64[::1], int64[::1]), cache=True, nogil=True)
def _rare_word(word, s, c):
    """Words of little traffic that neither emit nor look ahead: count them."""
    kind = word >> 12
    if kind == VECT_8:
        # A lone VECT_8 belongs to a triple whose first words are missing; the caller emits it.
        c[w3.C_BROKEN_TRIPLES] += 1
    elif kind == OTHERS:
        _others_begin(s, c, word & 0xFFF)
    elif kind == CONTINUED_4 or kind == CONTINUED_12:
        c[w3.C_BROKEN_CONTINUATIONS] += 1
    elif kind == LEGACY_Y:
        c[w3.C_LEGACY_Y_WORDS] += 1
    else:
        c[w3.C_UNKNOWN_WORDS] += 1
