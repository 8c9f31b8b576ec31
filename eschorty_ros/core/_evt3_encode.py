"""EVT3 encoding: the mirror image of the decoder, for simulation and tests."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import int64, njit, types, uint8, uint16, uint64
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.errors import ArgumentError

# Encoder state, one int64 each.
_HIGH, _LOW, _T_US, _Y, _BASE, _VPOL = range(6)
_NONE = -1

_SINGLES_MAX = 3
"""A vector group costs three words after another one, four otherwise: more events must share it."""

_IDLE_MAX_US = 3_600_000_000
"""Longest silence filled with TIME_HIGH words: one hour, 1.8 MB."""

_I8 = types.Array(int64, 1, "C", readonly=True)
_U2 = types.Array(uint16, 1, "C", readonly=True)
_U1 = types.Array(uint8, 1, "C", readonly=True)


@njit(uint64(int64, int64[::1], uint16[::1], uint64), cache=True, nogil=True)
def _put_time(t, s, words, n):
    """Words that bring the stream's time to ``t``: every TIME_HIGH on the way, then TIME_LOW."""
    if t == s[_T_US]:
        return n
    high = t >> 12
    if s[_HIGH] == _NONE:
        s[_HIGH] = high - 1
    while s[_HIGH] < high:
        s[_HIGH] += 1
        words[n] = np.uint16(0x8000 | (s[_HIGH] & 0xFFF))
        n += np.uint64(1)
        # Said even when it is 0: not every decoder zeroes the low bits by itself.
        s[_LOW] = _NONE
    low = t & 0xFFF
    if low != s[_LOW]:
        s[_LOW] = low
        words[n] = np.uint16(0x6000 | low)
        n += np.uint64(1)
    s[_T_US] = t
    # A readout begins: name the row again, as the sensor does.
    s[_Y] = _NONE
    return n


@njit(types.Tuple((uint64, types.uint32))(_U2, uint64, uint64, int64), cache=True, nogil=True)
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


@njit(
    uint64(uint64, uint64, _U2, int64, int64, int64, int64[::1], uint16[::1], uint64),
    cache=True,
    nogil=True,
)
def _put_row(k, end, x, y, p, width, s, words, n):
    """Events ``k`` to ``end``, of one time, row, polarity; as vectors where shorter."""
    if s[_Y] != y:
        words[n] = np.uint16(y)
        n += np.uint64(1)
        s[_Y] = y
        s[_BASE] = _NONE
    while k < end:
        first = np.int64(x[k])
        chained = s[_BASE] != _NONE and s[_VPOL] == p and s[_BASE] <= first < s[_BASE] + 32
        # A group never reaches past the sensor: other decoders refuse it.
        base = s[_BASE] if chained else min(first, width - 32)
        count = np.uint64(0)
        if base >= 0 and base + 32 <= width:
            count, mask = _group(x, k, end, base)
        if count <= np.uint64(_SINGLES_MAX if chained else _SINGLES_MAX + 1):
            words[n] = np.uint16(0x2000 | (p << 11) | first)
            n += np.uint64(1)
            k += np.uint64(1)
            continue
        if not chained:
            words[n] = np.uint16(0x3000 | (p << 11) | base)
            n += np.uint64(1)
            s[_VPOL] = p
        words[n] = np.uint16(0x4000 | (mask & np.uint32(0xFFF)))
        words[n + np.uint64(1)] = np.uint16(0x4000 | (mask >> np.uint32(12) & np.uint32(0xFFF)))
        words[n + np.uint64(2)] = np.uint16(0x5000 | mask >> np.uint32(24))
        n += np.uint64(3)
        s[_BASE] = base + 32
        k += count
    return n


@njit(
    uint64(_I8, _U2, _U2, _U1, _I8, _U1, int64, int64[::1], uint16[::1]), cache=True, nogil=True
)
def _encode(t, x, y, p, trigger_t, trigger_edge, width, s, words):
    """Merge events and triggers by time (triggers first); returns the number of words."""
    n = np.uint64(0)
    k = np.uint64(0)
    j = np.uint64(0)
    end = np.uint64(t.size)
    triggers = np.uint64(trigger_t.size)
    while k < end or j < triggers:
        if j < triggers and (k >= end or trigger_t[j] <= t[k]):
            n = _put_time(trigger_t[j], s, words, n)
            words[n] = np.uint16(0xA000 | np.int64(trigger_edge[j]))
            n += np.uint64(1)
            j += np.uint64(1)
            continue
        last = k + np.uint64(1)
        while last < end and t[last] == t[k] and y[last] == y[k] and p[last] == p[k]:
            last += np.uint64(1)
        if t[k] != s[_T_US]:
            n = _put_time(t[k], s, words, n)
        if last - k > np.uint64(_SINGLES_MAX):
            n = _put_row(k, last, x, np.int64(y[k]), np.int64(p[k]), width, s, words, n)
            k = last
            continue
        # Too few for a vector; no call, since each costs more than the words themselves.
        if s[_Y] != np.int64(y[k]):
            s[_Y] = np.int64(y[k])
            s[_BASE] = _NONE
            words[n] = y[k]
            n += np.uint64(1)
        while k < last:
            words[n] = np.uint16(0x2000 | np.int64(p[k]) << 11 | np.int64(x[k]))
            n += np.uint64(1)
            k += np.uint64(1)
    return n


@njit(int64(_I8, int64), cache=True, nogil=True)
def _first_fall(t, last):
    """Index of the first time below its predecessor, or -1."""
    for k in range(t.size):
        if t[np.uintp(k)] < last:
            return k
        last = t[np.uintp(k)]
    return -1


class Encoder:
    """Streaming EVT3 encoder.

    Events keep the order they are given in: the decoder returns exactly what went in. Runs of
    rising x with equal time, row and polarity become vector triples where that is shorter, so
    give events in readout order (``sort_readout``) for a compact stream. TIME_HIGH is written
    for every 4096 us that pass, also while nothing happens (``advance``).

    The stream carries 24 bits of time: a decoder that starts with this stream finds the same
    times when the first one lies below 2**24 us, otherwise modulo that.

    Parameters
    ----------
    width, height : int
        Sensor size in pixels, 1 to 2048.

    Raises
    ------
    ArgumentError
        When a size lies outside its range.
    """

    def __init__(self, width: int = 1280, height: int = 720) -> None:
        for name, size in (("width", width), ("height", height)):
            if not 1 <= size <= 2048:
                raise ArgumentError(f"{name} is {size!r}; choose 1 to 2048 pixels")
        self.width = int(width)
        self.height = int(height)
        self._state = np.full(6, _NONE, dtype=np.int64)
        self._words = np.empty(0, dtype="<u2")

    @property
    def time_us(self) -> int | None:
        """Time the stream has reached; ``None`` before the first word."""
        return None if self._state[_T_US] == _NONE else int(self._state[_T_US])

    def encode(
        self,
        t: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        p: ArrayLike,
        trigger_t: ArrayLike | None = None,
        trigger_edge: ArrayLike | None = None,
    ) -> bytes:
        """Bytes of the next events and triggers.

        Parameters
        ----------
        t : array_like of int, shape (n,)
            Microseconds, not falling, not before the time the stream has reached.
        x, y, p : array_like of int, shape (n,)
            Column, row, polarity (0 or 1).
        trigger_t, trigger_edge : array_like of int, shape (m,), optional
            Trigger times (not falling) and edges (1 = rising), channel 0; at equal times a
            trigger comes before the events.

        Raises
        ------
        ArgumentError
            For falling times, values outside the sensor, unequal lengths, or a silence of more
            than an hour. Nothing is encoded then.
        """
        times = _checked("t", t, np.int64, 1 << 62)
        columns = _checked("x", x, np.uint16, self.width)
        rows = _checked("y", y, np.uint16, self.height)
        polarities = _checked("p", p, np.uint8, 2)
        trigger_times = _checked("trigger_t", _or_none(trigger_t), np.int64, 1 << 62)
        edges = _checked("trigger_edge", _or_none(trigger_edge), np.uint8, 2)
        if not times.size == columns.size == rows.size == polarities.size:
            raise ArgumentError(
                f"t, x, y, p have {times.size}, {columns.size}, {rows.size}, {polarities.size} "
                "entries; give one of each per event"
            )
        if trigger_times.size != edges.size:
            raise ArgumentError(
                f"trigger_t has {trigger_times.size} entries and trigger_edge {edges.size}; "
                "give one edge per trigger"
            )
        for name, series in (("t", times), ("trigger_t", trigger_times)):
            self._refuse_fall(name, series)
        ends = [int(series[-1]) for series in (times, trigger_times) if series.size]
        if not ends:
            return b""
        starts = [int(series[0]) for series in (times, trigger_times) if series.size]
        steps = self._high_words(min(starts), max(ends))
        # At most TIME_LOW, ADDR_Y and ADDR_X for each event, TIME_LOW and the trigger for each.
        bound = 3 * times.size + 2 * edges.size + steps
        if self._words.size < bound:
            self._words = np.empty(bound, dtype="<u2")
        n = _encode(
            times,
            columns,
            rows,
            polarities,
            trigger_times,
            edges,
            self.width,
            self._state,
            self._words,
        )
        return self._words[:n].tobytes()

    def advance(self, t_us: int) -> bytes:
        """Time words that bring a silent stream to ``t_us``.

        Raises
        ------
        ArgumentError
            When ``t_us`` lies before the time the stream has reached, or more than an hour after.
        """
        self._refuse_fall("t_us", _checked("t_us", [t_us], np.int64, 1 << 62))
        words = np.empty(self._high_words(t_us, t_us) + 1, dtype="<u2")
        n = _put_time(t_us, self._state, words, 0)
        return words[:n].tobytes()

    def _refuse_fall(self, name: str, times: NDArray[np.int64]) -> None:
        fall = _first_fall(times, self._state[_T_US])
        if fall >= 0:
            before = times[fall - 1] if fall else self._state[_T_US]
            raise ArgumentError(
                f"{name}[{fall}] is {times[fall]} us, after {before} us; sort the events by time"
            )

    def _high_words(self, start_us: int, end_us: int) -> int:
        """Number of TIME_HIGH words up to ``end_us``."""
        begun_us = start_us if self._state[_T_US] == _NONE else int(self._state[_T_US])
        if end_us - begun_us > _IDLE_MAX_US:
            raise ArgumentError(
                f"time runs from {begun_us} to {end_us} us in one call; "
                f"stay within {_IDLE_MAX_US} us"
            )
        return (end_us >> 12) - (begun_us >> 12) + 1


def _or_none(values: ArrayLike | None) -> ArrayLike:
    return () if values is None else values


def _checked(name: str, values: ArrayLike, dtype: Any, limit: int) -> NDArray[Any]:
    """``values`` as a contiguous vector of ``dtype``, each in 0..limit-1."""
    array = np.asarray(values)
    if array.size == 0:
        return np.empty(0, dtype=dtype)
    if array.ndim != 1 or array.dtype.kind not in "iub":
        raise ArgumentError(
            f"{name} is {array.dtype} of shape {array.shape}; give a vector of integers"
        )
    lowest, highest = int(array.min()), int(array.max())
    if lowest < 0 or highest >= limit:
        wrong = lowest if lowest < 0 else highest
        raise ArgumentError(f"{name} holds {wrong}; values lie in 0 to {limit - 1}")
    return np.ascontiguousarray(array, dtype=dtype)


def sort_readout(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Events in the order a sensor reads them out: by time, row, polarity, column.

    Parameters
    ----------
    t, x, y, p : integer vectors of one length
        Times (us) within 2**40 us (12 days) of each other; x, y below 2048, p 0 or 1.

    Returns
    -------
    tuple of arrays
        Sorted copies: int64, uint16, uint16, uint8.

    Raises
    ------
    ArgumentError
        When the times span more, or a value lies outside its range.
    """
    times = _checked("t", t, np.int64, 1 << 62)
    columns = _checked("x", x, np.uint16, 2048)
    rows = _checked("y", y, np.uint16, 2048)
    polarities = _checked("p", p, np.uint8, 2)
    if times.size == 0:
        return times, columns, rows, polarities
    origin = times.min()
    if int(times.max()) - int(origin) >= 1 << 40:
        raise ArgumentError("t spans more than 2**40 us; sort shorter pieces")
    key = (times - origin) << 23 | rows.astype(np.int64) << 12
    key |= polarities.astype(np.int64) << 11 | columns
    key.sort()
    return (
        (key >> 23) + origin,
        (key & 0x7FF).astype(np.uint16),
        (key >> 12 & 0x7FF).astype(np.uint16),
        (key >> 11 & 1).astype(np.uint8),
    )
