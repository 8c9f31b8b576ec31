"""EVT3 encoding: the mirror image of the decoder, for simulation and tests."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import whole
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3._encode import NONE, T_US, _encode, _first_fall, _put_time

_TRIGGER = np.uint16(w3.EXT_TRIGGER << 12)
_DROP = np.uint16(w3.OTHERS << 12 | w3.DROPPED_EVENTS)
_COUNT_MAX = (1 << 28) - 1
_IDLE_MAX_US = 3_600_000_000
"""Longest silence filled with TIME_HIGH words: one hour, 1.8 MB."""


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
            whole(name, size, 1, w3.ADDRESSES)
        self.width = int(width)
        self.height = int(height)
        self._state = np.full(6, NONE, dtype=np.int64)
        self._words = np.empty(0, dtype="<u2")

    @property
    def time_us(self) -> int | None:
        """Time the stream has reached; ``None`` before the first word."""
        return None if self._state[T_US] == NONE else int(self._state[T_US])

    def encode(
        self,
        t: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        p: ArrayLike,
        trigger_t: ArrayLike | None = None,
        trigger_edge: ArrayLike | None = None,
        drop_t: ArrayLike | None = None,
        rate_counts: ArrayLike | None = None,
    ) -> bytes:
        """Bytes of the next events, triggers and notes of dropped events.

        Parameters
        ----------
        t : array_like of int, shape (n,)
            Microseconds, not falling, not before the time the stream has reached.
        x, y, p : array_like of int, shape (n,)
            Column, row, polarity (0 or 1).
        trigger_t, trigger_edge : array_like of int, shape (m,), optional
            Trigger times (not falling) and edges (1 = rising), channel 0; at equal times a
            trigger comes before the events.
        drop_t : array_like of int, shape (k,), optional
            Times (not falling) at which the stream says that the sensor dropped events.
        rate_counts : array_like of int, shape (j, 3), optional
            Reports of the event-rate control: time (not falling), events before and after it in
            the period that ends there, below 2**28.

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
        drop_times = _checked("drop_t", _or_none(drop_t), np.int64, 1 << 62)
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
        n = _encode(
            times,
            columns,
            rows,
            polarities,
            mark_times,
            marks,
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
        whole("t_us", t_us, 0, (1 << 62) - 1)
        self._refuse_fall("t_us", _checked("t_us", [t_us], np.int64, 1 << 62))
        words = np.empty(self._high_words(t_us, t_us) + 1, dtype="<u2")
        n = _put_time(t_us, True, self._state, words, 0)
        return words[:n].tobytes()

    def _refuse_fall(self, name: str, times: NDArray[np.int64]) -> None:
        fall = _first_fall(times, self._state[T_US])
        if fall >= 0:
            before = times[fall - 1] if fall else self._state[T_US]
            raise ArgumentError(
                f"{name}[{fall}] is {times[fall]} us, after {before} us; sort the events by time"
            )

    def _high_words(self, start_us: int, end_us: int) -> int:
        """Return number of TIME_HIGH words up to ``end_us``."""
        begun_us = start_us if self._state[T_US] == NONE else int(self._state[T_US])
        if end_us - begun_us > _IDLE_MAX_US:
            raise ArgumentError(
                f"time runs from {begun_us} to {end_us} us in one call; "
                f"stay within {_IDLE_MAX_US} us"
            )
        return (end_us >> 12) - (begun_us >> 12) + 1


def _reports(rate_counts: ArrayLike | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return times of the rate control's reports, and per report the events before and after it."""
    given = np.asarray(() if rate_counts is None else rate_counts)
    if given.size == 0:
        return np.empty(0, dtype=np.int64), np.empty((0, 2), dtype=np.int64)
    if given.ndim != 2 or given.shape[1] != 3:
        raise ArgumentError(
            f"rate_counts has shape {given.shape}; give time, events before and after per report"
        )
    limits = ((1 << 62), _COUNT_MAX + 1, _COUNT_MAX + 1)
    times, *counts = (
        _checked("rate_counts", given[:, k], np.int64, limit) for k, limit in enumerate(limits)
    )
    return times, np.column_stack(counts)


def _report_words(counts: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Eight words per report: two OTHERS with 28 bits of payload each."""
    words = np.empty((len(counts), 2, 4), dtype=np.uint16)
    words[:, :, 0] = w3.OTHERS << 12 | np.array((w3.ERC_EVENTS_IN, w3.ERC_EVENTS_OUT))
    words[:, :, 1] = w3.CONTINUED_12 << 12 | counts & 0xFFF
    words[:, :, 2] = w3.CONTINUED_12 << 12 | counts >> 12 & 0xFFF
    words[:, :, 3] = w3.CONTINUED_4 << 12 | counts >> 24
    return words.ravel()


def _merged_marks(
    *series: tuple[NDArray[np.int64], NDArray[np.uint16]],
) -> tuple[NDArray[np.int64], NDArray[np.uint16]]:
    """Words that are no events by time; at equal times in the order given."""
    filled = [one for one in series if one[0].size]
    if len(filled) == 1:
        return filled[0]
    times = np.concatenate([one[0] for one in series])
    marks = np.concatenate([one[1] for one in series])
    order = np.argsort(times, kind="stable")
    return times[order], marks[order]


def _or_none(values: ArrayLike | None) -> ArrayLike:
    return () if values is None else values


def _checked(name: str, values: ArrayLike, dtype: Any, limit: int) -> NDArray[Any]:
    """``values`` as a contiguous vector of ``dtype``, each in 0..limit-1."""
    array = np.asarray(values)
    if array.size == 0 and array.ndim == 1:
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
    columns = _checked("x", x, np.uint16, w3.ADDRESSES)
    rows = _checked("y", y, np.uint16, w3.ADDRESSES)
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
