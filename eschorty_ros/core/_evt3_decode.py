"""Compiled EVT3 decoding: one pass over the words, state in an int64 array.

The hot words (ADDR_Y, ADDR_X, whole vector triples, TIME_LOW) are handled here; all others go
through the small functions of ``_evt3_rare``.
"""

from __future__ import annotations

import numpy as np
from numba import int64, njit, types, uint64

from eschorty_ros.core import _evt3_words as w3
from eschorty_ros.core._bits import ctz64
from eschorty_ros.core._evt3_rare import (
    OUT,
    TRIGGERS,
    WORDS,
    _drop_x,
    _others_payload,
    _rare_word,
    _skip_to_time,
    _time_high,
    _triple_by_words,
    _vector,
)
from eschorty_ros.core._evt3_words import (
    ADDR_X,
    ADDR_Y,
    EXT_TRIGGER,
    LEGACY_Y,
    NO_Y,
    OTHERS,
    S_BASE,
    S_EPOCH_US,
    S_FLOOR_US,
    S_LIMIT,
    S_LOW,
    S_OTHERS,
    S_PHASE,
    S_RUN,
    S_T_US,
    S_VPOL,
    S_Y,
    TIME_HIGH,
    TIME_LOW,
    VECT_8,
    VECT_12,
    VECT_BASE_X,
)


@njit(
    types.Tuple((uint64, uint64))(WORDS, int64, int64, int64[::1], int64[::1], OUT, TRIGGERS),
    cache=True,
    nogil=True,
)
def _decode(words, width, height, s, c, out, trig):
    """Decode all ``words``; returns the numbers of events and triggers written.

    ``S_LIMIT`` is the width while the row is valid and 0 otherwise, so that one comparison
    settles both; ``out`` holds at least ``_bounds(words)`` entries.
    """
    t_out, x_out, y_out, p_out = out
    end = np.uint64(words.size)
    one = np.uint64(1)
    i = np.uint64(0)
    n = np.uint64(0)
    m = np.uint64(0)
    if s[S_RUN] != w3.RUN_ON:
        i = _skip_to_time(words, i, c)
    t = s[S_T_US]
    floor = s[S_FLOOR_US]
    mark = np.uint64(0)
    y = s[S_Y]
    limit = s[S_LIMIT]
    if i < end and s[S_PHASE] > 0:
        i, n = _triple_by_words(words, i, t, y, s, c, out, n)
    if i < end and s[S_OTHERS] > 0:
        i = _others_payload(words, i, s, c)
    while i < end:
        word = np.uint32(words[i])
        kind = word >> np.uint32(12)
        i += one
        if kind == ADDR_Y:
            y = np.int64(word & np.uint32(0x7FF))
            limit = width if y < height else 0
            if limit == 0:
                c[w3.C_Y_PAST_HEIGHT] += 1
            if i >= end:
                break
            # The usual successor, without another turn of the loop.
            word = np.uint32(words[i])
            kind = word >> np.uint32(12)
            if kind != ADDR_X:
                continue
            i += one
        if kind == ADDR_X:
            x = np.int64(word & np.uint32(0x7FF))
            if x < limit:
                t_out[n] = t
                x_out[n] = np.uint16(x)
                y_out[n] = np.uint16(y)
                p_out[n] = np.uint8((word >> np.uint32(11)) & np.uint32(1))
                n += one
            else:
                _drop_x(c, y, limit)
        elif kind == VECT_12:
            base = s[S_BASE]
            if (
                i + one < end
                and words[i] >> 12 == VECT_12
                and words[i + one] >> 12 == VECT_8
                and base + 32 <= limit
            ):
                mask = (
                    (np.uint64(word) & np.uint64(0xFFF))
                    | (np.uint64(words[i]) & np.uint64(0xFFF)) << np.uint64(12)
                    | (np.uint64(words[i + one]) & np.uint64(0xFF)) << np.uint64(24)
                )
                i += np.uint64(2)
                p = np.uint8(s[S_VPOL])
                s[S_BASE] = base + 32
                while mask != np.uint64(0):
                    t_out[n] = t
                    x_out[n] = np.uint16(base + np.int64(ctz64(mask)))
                    y_out[n] = np.uint16(y)
                    p_out[n] = p
                    n += one
                    mask &= mask - one
            else:
                s[S_LIMIT] = limit
                i, n = _triple_by_words(words, i - one, t, y, s, c, out, n)
        elif kind == VECT_BASE_X:
            s[S_BASE] = np.int64(word & np.uint32(0x7FF))
            s[S_VPOL] = np.int64((word >> np.uint32(11)) & np.uint32(1))
        elif kind == TIME_LOW:
            # The sensor corrects a TIME_LOW at once with a lower one: only a time that was handed
            # out may not be undercut.
            if n + m != mark:
                mark = n + m
                floor = t
            s[S_LOW] = np.int64(word & np.uint32(0xFFF))
            t = s[S_EPOCH_US] + s[S_LOW]
            if t < floor:
                c[w3.C_TIME_LOW_BACK] += 1
                t = floor
        elif kind == TIME_HIGH:
            if n + m != mark:
                mark = n + m
                floor = t
            t = _time_high(s, c, np.int64(word & np.uint32(0xFFF)), floor)
        elif kind == EXT_TRIGGER:
            trig[0][m] = t
            trig[1][m] = np.uint8((word >> np.uint32(8)) & np.uint32(0xF))
            trig[2][m] = np.uint8(word & np.uint32(1))
            m += one
        else:
            _rare_word(np.int64(word), s, c)
            if kind == VECT_8:
                s[S_LIMIT] = limit
                n = _vector(np.uint64(word) & np.uint64(0xFF), np.uint64(8), t, y, s, c, out, n)
            elif kind == LEGACY_Y:
                y = np.int64(NO_Y)
                limit = 0
            elif kind == OTHERS:
                i = _others_payload(words, i, s, c)
    s[S_T_US] = t
    s[S_FLOOR_US] = t if n + m != mark else floor
    s[S_Y] = y
    s[S_LIMIT] = limit
    c[w3.C_EVENTS] += n
    c[w3.C_TRIGGERS] += m
    return n, m
