"""Compiled EVT3 encoding; see ``_evt3_encode``."""

from __future__ import annotations

import numpy as np
from numba import int64, types, uint8, uint16, uint64

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.evt3 import words as w3

# Encoder state, one int64 each.
_HIGH, _LOW, T_US, _Y, _BASE, _VPOL = range(6)
NONE = -1

_SINGLES_MAX = 3
"""A vector group costs three words after another one, four otherwise: more events must share it."""

_I8 = types.Array(int64, 1, "C", readonly=True)
_U2 = types.Array(uint16, 1, "C", readonly=True)
_U1 = types.Array(uint8, 1, "C", readonly=True)


@kernel(uint64(int64, types.boolean, int64[::1], uint16[::1], uint64))
def _put_time(t, idle, s, words, n):
    """Words that bring the stream's time to ``t``: every TIME_HIGH on the way, then TIME_LOW.

    Before an event TIME_LOW is said even when it is 0: not every decoder zeroes the low bits by
    itself. An idle stream that stops at a whole TIME_HIGH leaves it to what comes.
    """
    high = t >> 12
    if s[_HIGH] == NONE:
        s[_HIGH] = high - 1
    while s[_HIGH] < high:
        s[_HIGH] += 1
        words[n] = np.uint16(w3.TIME_HIGH << 12 | (s[_HIGH] & 0xFFF))
        n += np.uint64(1)
        s[_LOW] = NONE
    low = t & 0xFFF
    if low != s[_LOW] and not (idle and low == 0):
        s[_LOW] = low
        words[n] = np.uint16(w3.TIME_LOW << 12 | low)
        n += np.uint64(1)
    if t != s[T_US]:
        # A readout begins: name the row again, as the sensor does.
        s[T_US] = t
        s[_Y] = NONE
    return n


@kernel(types.Tuple((uint64, types.uint32))(_U2, uint64, uint64, int64))
def _group(x, k, end, base):
    """Events from ``k`` on that fit one 32-pixel group at ``base``, x rising.

    Returns their count and mask.
    """
    mask = np.uint32(0)
    count = np.uint64(0)
    last = np.int64(-1)
    while k < end:
        column = np.int64(x[k])
        if column <= last or column < base or column >= base + 32:
            break
        mask |= np.uint32(1) << np.uint32(column - base)
        last = column
        count += np.uint64(1)
        k += np.uint64(1)
    return count, mask


@kernel(uint64(uint64, uint64, _U2, int64, int64, int64, int64[::1], uint16[::1], uint64))
def _put_row(k, end, x, y, p, width, s, words, n):
    """Events ``k`` to ``end``, of one time, row, polarity; as vectors where shorter."""
    if s[_Y] != y:
        words[n] = np.uint16(w3.ADDR_Y << 12 | y)
        n += np.uint64(1)
        s[_Y] = y
        s[_BASE] = NONE
    while k < end:
        first = np.int64(x[k])
        chained = s[_BASE] != NONE and s[_VPOL] == p and s[_BASE] <= first < s[_BASE] + 32
        # A group never reaches past the sensor: other decoders refuse it.
        base = s[_BASE] if chained else min(first, width - 32)
        count = np.uint64(0)
        if base >= 0 and base + 32 <= width:
            count, mask = _group(x, k, end, base)
        if count <= np.uint64(_SINGLES_MAX if chained else _SINGLES_MAX + 1):
            words[n] = np.uint16(w3.ADDR_X << 12 | (p << 11) | first)
            n += np.uint64(1)
            k += np.uint64(1)
            continue
        if not chained:
            words[n] = np.uint16(w3.VECT_BASE_X << 12 | (p << 11) | base)
            n += np.uint64(1)
            s[_VPOL] = p
        words[n] = np.uint16(w3.VECT_12 << 12 | (mask & np.uint32(0xFFF)))
        words[n + np.uint64(1)] = np.uint16(
            w3.VECT_12 << 12 | (mask >> np.uint32(12) & np.uint32(0xFFF))
        )
        words[n + np.uint64(2)] = np.uint16(w3.VECT_8 << 12 | mask >> np.uint32(24))
        n += np.uint64(3)
        s[_BASE] = base + 32
        k += count
    return n


@kernel(uint64(_I8, _U2, _U2, _U1, _I8, _U2, int64, int64[::1], uint16[::1]))
def _encode(t, x, y, p, mark_t, marks, width, s, words):
    """Merge events and ready-made words by time (these first); returns the number of words."""
    n = np.uint64(0)
    k = np.uint64(0)
    j = np.uint64(0)
    end = np.uint64(t.size)
    count = np.uint64(mark_t.size)
    while k < end or j < count:
        if j < count and (k >= end or mark_t[j] <= t[k]):
            n = _put_time(mark_t[j], False, s, words, n)
            words[n] = marks[j]
            n += np.uint64(1)
            j += np.uint64(1)
            continue
        last = k + np.uint64(1)
        while last < end and t[last] == t[k] and y[last] == y[k] and p[last] == p[k]:
            last += np.uint64(1)
        if t[k] != s[T_US] or s[_LOW] == NONE:
            n = _put_time(t[k], False, s, words, n)
        if last - k > np.uint64(_SINGLES_MAX):
            n = _put_row(k, last, x, np.int64(y[k]), np.int64(p[k]), width, s, words, n)
            k = last
            continue
        # Too few for a vector; no call, since each costs more than the words themselves.
        if s[_Y] != np.int64(y[k]):
            s[_Y] = np.int64(y[k])
            s[_BASE] = NONE
            words[n] = np.uint16(w3.ADDR_Y << 12 | y[k])
            n += np.uint64(1)
        while k < last:
            words[n] = np.uint16(w3.ADDR_X << 12 | np.int64(p[k]) << 11 | np.int64(x[k]))
            n += np.uint64(1)
            k += np.uint64(1)
    return n


@kernel(int64(_I8, int64))
def _first_fall(t, last):
    """Index of the first time below its predecessor, or -1."""
    for k in range(t.size):
        if t[np.uintp(k)] < last:
            return k
        last = t[np.uintp(k)]
    return -1
