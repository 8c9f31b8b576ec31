"""Streaming EVT3 encoder, the inverse of the decoder, for simulation and tests."""

from __future__ import annotations

import numpy as np
from numba import int64, typeof, types, uint8, uint16, uint64
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import integer_vector
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import entry_kernel, kernel, record
from eschorty_ros.core.base.numbers import integer
from eschorty_ros.core.base.sort_keys import sort_keys
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3.events import EventArrays, _first_fall

_TRIGGER = np.uint16(w3.EXT_TRIGGER << 12)
_DROP = np.uint16(w3.OTHERS << 12 | w3.DROPPED_EVENTS)
_COUNT_MAX = (1 << 28) - 1
_T_MAX = (1 << 62) - 1
_IDLE_MAX_US = 3_600_000_000
"""Longest time without events that is filled with TIME_HIGH words: one hour, 1.8 MB."""
_STATE = ("high", "low", "t_us", "row", "base", "polarity", "width")
_NONE = -1

_SINGLES_MAX = 3
"""A vector group costs three words after another one, four otherwise: more events must share it."""


class Encoder:
    """Streaming EVT3 encoder.

    Events keep their order: the decoder returns exactly what went in. Runs of rising x with equal
    time, row and polarity become vector triples where that is shorter, so give events in readout
    order (``sort_readout``) for a compact stream. TIME_HIGH is written for every 4096 us that
    pass, also without events (``advance``).

    The stream carries 24 bits of time: a decoder that starts with it finds the same times when the
    first lies below 2**24 us, otherwise modulo 2**24.

    - ``width``, ``height``: Sensor size in pixels, 1 to 2048.

    Raises ``ArgumentError`` when a size is outside its range.
    """

    def __init__(self, width: int = 1280, height: int = 720) -> None:
        self.width = integer("width", width, 1, w3.ADDRESSES)
        self.height = integer("height", height, 1, w3.ADDRESSES)
        self._state = record(*_STATE, value=_NONE)
        self._state["width"] = self.width
        self._words = np.empty(0, dtype="<u2")

    @property
    def time_us(self) -> int | None:
        """Time the stream has reached (us); ``None`` before the first word."""
        return None if self._state["t_us"] == _NONE else int(self._state["t_us"])

    def encode(
        self,
        t: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        p: ArrayLike,
        trigger_t: ArrayLike = (),
        trigger_edge: ArrayLike = (),
        drop_t: ArrayLike = (),
        rate_counts: ArrayLike = (),
    ) -> bytes:
        """Return the bytes of the next events, triggers and notes of dropped events.

        - ``t``: Shape (n,). Microseconds, not falling, not before the time the stream has reached.
        - ``x``, ``y``, ``p``: Shape (n,). Column, row, polarity (0 or 1).
        - ``trigger_t``, ``trigger_edge``: Shape (m,). Trigger times (not falling) and edges (1 =
          rising), channel 0; at equal times a trigger comes before the events.
        - ``drop_t``: Shape (k,). Times (not falling) at which the stream notes that the sensor
          dropped events.
        - ``rate_counts``: Shape (j, 3). Reports of the event-rate control: time (not falling),
          events before and after it in the period that ends there, below 2**28.

        Raises ``ArgumentError`` for falling times, values outside the sensor, unequal lengths, or
        more than an hour without events. Nothing is encoded then.
        """
        times = integer_vector("t", t, np.int64, 0, _T_MAX)
        columns = integer_vector("x", x, np.uint16, 0, self.width - 1)
        rows = integer_vector("y", y, np.uint16, 0, self.height - 1)
        polarities = integer_vector("p", p, np.uint8, 0, 1)
        trigger_times = integer_vector("trigger_t", trigger_t, np.int64, 0, _T_MAX)
        edges = integer_vector("trigger_edge", trigger_edge, np.uint8, 0, 1)
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
        drop_times = integer_vector("drop_t", drop_t, np.int64, 0, _T_MAX)
        report_times, counts = _reports(rate_counts)
        for name, series in (
            ("t", times),
            ("trigger_t", trigger_times),
            ("drop_t", drop_times),
            ("rate_counts", report_times),
        ):
            self._refuse_fall(name, series)
        mark_times, marks = _merged_marks(
            (trigger_times, _TRIGGER | edges.astype(np.uint16)),
            (drop_times, np.full(drop_times.size, _DROP, dtype=np.uint16)),
            (np.repeat(report_times, 8), _report_words(counts)),
        )
        ends = [int(series[-1]) for series in (times, mark_times) if series.size]
        if not ends:
            return b""
        starts = [int(series[0]) for series in (times, mark_times) if series.size]
        steps = self._high_words(min(starts), max(ends))
        # At most TIME_LOW, ADDR_Y and ADDR_X for each event, TIME_LOW and the word for each mark.
        bound = 3 * times.size + 2 * marks.size + steps
        if self._words.size < bound:
            self._words = np.empty(bound, dtype="<u2")
        n = _encode(times, columns, rows, polarities, mark_times, marks, self._state, self._words)
        return self._words[:n].tobytes()

    def advance(self, t_us: int) -> bytes:
        """Return the time words that bring a stream without events to ``t_us``.

        Raises ``ArgumentError`` when ``t_us`` lies before the time the stream has reached, or more
        than an hour after.
        """
        integer("t_us", t_us, 0, _T_MAX)
        self._refuse_fall("t_us", np.array([t_us], np.int64))
        words = np.empty(self._high_words(t_us, t_us) + 1, dtype="<u2")
        n = _put_time(t_us, True, self._state, words, 0)
        return words[:n].tobytes()

    def _refuse_fall(self, name: str, times: NDArray[np.int64]) -> None:
        fall = _first_fall(times, self._state["t_us"])
        if fall >= 0:
            before = times[fall - 1] if fall else self._state["t_us"]
            raise ArgumentError(
                f"{name}[{fall}] is {times[fall]} us, after {before} us; sort the events by time"
            )

    def _high_words(self, start_us: int, end_us: int) -> int:
        """Return the number of TIME_HIGH words up to ``end_us``."""
        begun_us = start_us if self._state["t_us"] == _NONE else int(self._state["t_us"])
        if end_us - begun_us > _IDLE_MAX_US:
            raise ArgumentError(
                f"time runs from {begun_us} to {end_us} us in one call; "
                f"stay within {_IDLE_MAX_US} us"
            )
        return (end_us >> 12) - (begun_us >> 12) + 1


def _reports(rate_counts: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return times of the rate control's reports, and per report the events before and after it."""
    given = np.asarray(rate_counts)
    if given.size == 0:
        return np.empty(0, dtype=np.int64), np.empty((0, 2), dtype=np.int64)
    if given.ndim != 2 or given.shape[1] != 3:
        raise ArgumentError(
            f"rate_counts has shape {given.shape}; give time, events before and after per report"
        )
    limits = (_T_MAX, _COUNT_MAX, _COUNT_MAX)
    times, *counts = (
        integer_vector("rate_counts", given[:, k], np.int64, 0, limit)
        for k, limit in enumerate(limits)
    )
    return times, np.column_stack(counts)


def _report_words(counts: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Return eight words per report: two OTHERS with 28 bits of payload each."""
    words = np.empty((len(counts), 2, 4), dtype=np.uint16)
    words[:, :, 0] = w3.OTHERS << 12 | np.array((w3.ERC_EVENTS_IN, w3.ERC_EVENTS_OUT))
    words[:, :, 1] = w3.CONTINUED_12 << 12 | counts & 0xFFF
    words[:, :, 2] = w3.CONTINUED_12 << 12 | counts >> 12 & 0xFFF
    words[:, :, 3] = w3.CONTINUED_4 << 12 | counts >> 24
    return words.ravel()


def _merged_marks(
    *series: tuple[NDArray[np.int64], NDArray[np.uint16]],
) -> tuple[NDArray[np.int64], NDArray[np.uint16]]:
    """Return times and words of all series by time; at equal times in the order given."""
    filled = [one for one in series if one[0].size]
    if len(filled) == 1:
        return filled[0]
    times = np.concatenate([one[0] for one in series])
    marks = np.concatenate([one[1] for one in series])
    order = np.argsort(times, kind="stable")
    return times[order], marks[order]


def sort_readout(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8]
) -> EventArrays:
    """Return events in the order a sensor reads them out: by time, row, polarity, column.

    - ``t``, ``x``, ``y``, ``p``: Times (us) within 2**40 us (12 days) of each other; x, y below
      2048, p 0 or 1.

    Raises ``ArgumentError`` when the times span more, or a value is outside its range.
    """
    times = integer_vector("t", t, np.int64, 0, _T_MAX)
    columns = integer_vector("x", x, np.uint16, 0, w3.ADDRESSES - 1)
    rows = integer_vector("y", y, np.uint16, 0, w3.ADDRESSES - 1)
    polarities = integer_vector("p", p, np.uint8, 0, 1)
    if times.size == 0:
        return EventArrays(times, columns, rows, polarities)
    origin = times.min()
    if int(times.max()) - int(origin) >= 1 << 40:
        raise ArgumentError("t spans more than 2**40 us; sort shorter pieces")
    key = times - origin
    for values, bits in ((rows, 11), (polarities, 1), (columns, 11)):
        key <<= bits
        key |= values
    sort_keys(key)
    columns = key.astype(np.uint16) & 0x7FF
    polarities = (key >> 11).astype(np.uint8) & 1
    rows = (key >> 12).astype(np.uint16) & 0x7FF
    key >>= 23
    key += origin
    return EventArrays(key, columns, rows, polarities)


_STREAM = typeof(record(*_STATE))
_I8 = types.Array(int64, 1, "C", readonly=True)
_U2 = types.Array(uint16, 1, "C", readonly=True)
_U1 = types.Array(uint8, 1, "C", readonly=True)


@entry_kernel(uint64(int64, types.boolean, _STREAM, uint16[::1], uint64))
def _put_time(t, idle, s, words, n):
    """Bring the stream's time to ``t``: write every TIME_HIGH on the way, then TIME_LOW.

    Before an event TIME_LOW is written even when it is 0: not every decoder zeroes the low bits by
    itself. An ``idle`` stream that stops at a multiple of TIME_HIGH leaves it out.
    """
    high = t >> 12
    if s.high == _NONE:
        s.high = high - 1
    while s.high < high:
        s.high += 1
        words[n] = np.uint16(w3.TIME_HIGH << 12 | (s.high & 0xFFF))
        n += np.uint64(1)
        s.low = _NONE
    low = t & 0xFFF
    if low != s.low and not (idle and low == 0):
        s.low = low
        words[n] = np.uint16(w3.TIME_LOW << 12 | low)
        n += np.uint64(1)
    if t != s.t_us:
        # A readout begins: the row is written again, as the sensor does.
        s.t_us = t
        s.row = _NONE
    return n


@kernel
def _group(x, k, end, base):
    """Return count and mask of the events from ``k`` on that fit a 32-pixel group, x rising."""
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


@kernel
def _put_row(k, end, x, y, p, s, words, n):
    """Write events ``k`` to ``end``, of one time, row, polarity; as vectors where shorter."""
    if s.row != y:
        words[n] = np.uint16(w3.ADDR_Y << 12 | y)
        n += np.uint64(1)
        s.row = y
        s.base = _NONE
    while k < end:
        first = np.int64(x[k])
        chained = s.base != _NONE and s.polarity == p and s.base <= first < s.base + 32
        # A group never reaches past the sensor: other decoders refuse it.
        base = s.base if chained else min(first, s.width - 32)
        count = np.uint64(0)
        if base >= 0 and base + 32 <= s.width:
            count, mask = _group(x, k, end, base)
        if count <= np.uint64(_SINGLES_MAX if chained else _SINGLES_MAX + 1):
            words[n] = np.uint16(w3.ADDR_X << 12 | (p << 11) | first)
            n += np.uint64(1)
            k += np.uint64(1)
            continue
        if not chained:
            words[n] = np.uint16(w3.VECT_BASE_X << 12 | (p << 11) | base)
            n += np.uint64(1)
            s.polarity = p
        words[n] = np.uint16(w3.VECT_12 << 12 | (mask & np.uint32(0xFFF)))
        words[n + np.uint64(1)] = np.uint16(
            w3.VECT_12 << 12 | (mask >> np.uint32(12) & np.uint32(0xFFF))
        )
        words[n + np.uint64(2)] = np.uint16(w3.VECT_8 << 12 | mask >> np.uint32(24))
        n += np.uint64(3)
        s.base = base + 32
        k += count
    return n


@entry_kernel(uint64(_I8, _U2, _U2, _U1, _I8, _U2, _STREAM, uint16[::1]))
def _encode(t, x, y, p, mark_t, marks, s, words):
    """Merge events and marks by time, marks first; return the number of words."""
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
        if t[k] != s.t_us or s.low == _NONE:
            n = _put_time(t[k], False, s, words, n)
        if last - k > np.uint64(_SINGLES_MAX):
            n = _put_row(k, last, x, np.int64(y[k]), np.int64(p[k]), s, words, n)
            k = last
            continue
        # Too few for a vector; no call, since each costs more than the words themselves.
        if s.row != np.int64(y[k]):
            s.row = np.int64(y[k])
            s.base = _NONE
            words[n] = np.uint16(w3.ADDR_Y << 12 | y[k])
            n += np.uint64(1)
        while k < last:
            words[n] = np.uint16(w3.ADDR_X << 12 | np.int64(p[k]) << 11 | np.int64(x[k]))
            n += np.uint64(1)
            k += np.uint64(1)
    return n
