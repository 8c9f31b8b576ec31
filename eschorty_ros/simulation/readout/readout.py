"""Readout of the sensor: row by row, and at a limited rate when one is set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import entry_kernel, kernel, record
from eschorty_ros.core.base.sort_keys import sort_keys

DROP_NOTE_US = 1000
"""Least time between two reports of the sensor that its readout drops events."""

_STATE = (
    "row_ns",  # time the arbiter spends on one row
    "limit_period_us",  # period of the rate control, 0 for none
    "limit_events",  # events it lets through per period
    "free_ns",  # time at which the arbiter is free
    "queued",  # rows in the queue
    "first",  # place of the first of them
    "waiting",  # events in the queue
    "dropped",  # events the arbiter had no room for
    "noted",  # last span of DROP_NOTE_US in which a drop was reported, -1 for none
    "period",  # of the rate control, -1 for none begun
    "came",  # events that reached it in this period
    "passed",  # events that it let through in this period
    "cut",  # events it dropped
)


@dataclass(frozen=True, slots=True)
class EventRate:
    """Limit of the event-rate control.

    Raises ``ArgumentError`` for a value outside its range.
    """

    events: int
    """First events of every period that leave the sensor; the others are dropped."""
    period_us: int

    def __post_init__(self) -> None:
        if self.events < 0:
            raise ArgumentError(f"events is {self.events!r}; choose 0 or more")
        if self.period_us < 1:
            raise ArgumentError(f"period_us is {self.period_us!r}; choose 1 or more")


@dataclass(frozen=True, slots=True)
class ReadoutParameters:
    """Parameters of the readout; a model, the sensor's are not published.

    Raises ``ArgumentError`` for a value outside its range.
    """

    row_time_us: float = 0.5
    """Time the arbiter spends on one row, however many events that has."""
    waiting_max: int = 1 << 17
    """Events that may wait for the arbiter; more are dropped."""

    def __post_init__(self) -> None:
        if not 1e-3 <= self.row_time_us <= 1e6:
            raise ArgumentError(f"row_time_us is {self.row_time_us!r}; choose 0.001 to 1e6")
        if not 1 <= self.waiting_max <= 1 << 24:
            raise ArgumentError(f"waiting_max is {self.waiting_max!r}; choose 1 to {1 << 24}")


class ReadOut(NamedTuple):
    """Events that left the sensor, and its reports."""

    keys: NDArray[np.int64]
    """Events, sorted."""
    drops_us: NDArray[np.int64]
    """Times at which the sensor reports that its readout is full: once per ``DROP_NOTE_US``."""
    periods: NDArray[np.int64]
    """Periods of the rate control that had events, shape (n, 3): their end (us), events before and
    after the control."""


class _Queue(NamedTuple):
    """Rows that wait and the time of each request; the events of each as a chain.

    ``heads`` has per row the last event, and as last entry the first free place; ``links`` per
    event the one before it, and per free place the next one. -1 ends a chain.
    """

    rows: NDArray[np.int64]
    heads: NDArray[np.int64]
    links: NDArray[np.int64]
    keys: NDArray[np.int64]


class _Out(NamedTuple):
    """Arrays of :class:`ReadOut` and the number of their entries written."""

    keys: NDArray[np.int64]
    drops_us: NDArray[np.int64]
    periods: NDArray[np.int64]
    counts: Any


class Readout:
    """The row arbiter: rows queue in the order of their requests and are read out completely.

    All events of a row that wait when its turn comes share the time of the readout; two requests
    of one pixel by then are read as one event, which ``merged`` counts. The arbiter is followed by
    the event-rate control, off until :meth:`limit`. The events do not depend on the spacing of
    calls.

    - ``rows``: Height of the sensor.
    """

    def __init__(self, rows: int, parameters: ReadoutParameters | None = None) -> None:
        p = parameters or ReadoutParameters()
        self.merged = 0
        self._cut_short = np.empty((0, 3), dtype=np.int64)
        self._state = record(*_STATE)
        self._state["row_ns"] = round(p.row_time_us * 1000)
        self._state["noted"] = self._state["period"] = -1
        self._queue = _Queue(
            rows=np.empty((rows, 2), dtype=np.int64),
            heads=np.append(np.full(rows, -1), 0),
            links=np.append(np.arange(1, p.waiting_max), -1),
            keys=np.empty(p.waiting_max, dtype=np.int64),
        )

    @property
    def dropped(self) -> int:
        """Events lost so far because too many waited."""
        return int(self._state["dropped"])

    @property
    def rate_dropped(self) -> int:
        """Events the rate control has dropped so far."""
        return int(self._state["cut"])

    def limit(self, t_us: int, rate: EventRate | None) -> None:
        """Limit the rate from ``t_us`` on, up to which everything has been read out.

        ``None`` lets everything through. The period under way ends.
        """
        state = self._state
        if state["limit_period_us"] and state["came"]:
            ended = np.array([[t_us, state["came"], state["passed"]]])
            self._cut_short = np.concatenate((self._cut_short, ended))
        state["came"], state["passed"], state["period"] = 0, 0, -1
        state["limit_period_us"] = rate.period_us if rate else 0
        state["limit_events"] = rate.events if rate else 0

    def read_out(self, requests: NDArray[np.int64], until_us: int) -> ReadOut:
        """Return the events that are read out before ``until_us``, and the sensor's reports.

        - ``requests``: All event keys of :meth:`PixelArray.take` up to ``until_us`` not given
          before, sorted.
        """
        events_max = requests.size + int(self._state["waiting"])
        periods_max = events_max + 1 if self._state["limit_period_us"] else 0
        out = _Out(
            keys=np.empty(events_max, dtype=np.int64),
            drops_us=np.empty(requests.size, dtype=np.int64),
            periods=np.empty((periods_max, 3), np.int64),
            counts=record("keys", "drops", "periods"),
        )
        _read_out(requests, until_us, self._state, self._queue, out)
        n = int(out.counts["keys"])
        keys = out.keys[:n]
        sort_keys(keys)
        # np.unique hashes and is ten times slower here.
        fresh = np.append(True, keys[1:] != keys[:-1])[:n]
        if not fresh.all():
            keys = keys[fresh]
            self.merged += n - keys.size
        periods = out.periods[: out.counts["periods"]]
        if self._cut_short.size:
            periods = np.concatenate((self._cut_short, periods))
            self._cut_short = self._cut_short[:0]
        return ReadOut(keys, out.drops_us[: out.counts["drops"]], periods)


@kernel
def _drop(t_us, state, out):
    """Count an event that the arbiter has no room for; report the first of a time span."""
    state.dropped += 1
    if state.noted != t_us // DROP_NOTE_US:
        state.noted = t_us // DROP_NOTE_US
        out.drops_us[out.counts.drops] = t_us
        out.counts.drops += 1


@kernel
def _end_period(state, out):
    """End the period of the rate control; report its events before and after it."""
    if state.came > 0:
        k = out.counts.periods
        out.periods[k, 0] = (state.period + 1) * state.limit_period_us
        out.periods[k, 1], out.periods[k, 2] = state.came, state.passed
        out.counts.periods += 1
    state.came, state.passed, state.period = 0, 0, -1


@kernel
def _serve(until_us, state, queue, out):
    """Read out rows as long as one is due before ``until_us``."""
    heads, links = queue.heads, queue.links
    n = out.counts.keys
    while state.queued > 0:
        row, request_us = queue.rows[state.first, 0], queue.rows[state.first, 1]
        begin_ns = max(state.free_ns, request_us * 1000)
        t_us = -(-begin_ns // 1000)
        if t_us >= until_us:
            break
        state.first = (state.first + 1) % queue.rows.shape[0]
        state.queued -= 1
        state.free_ns = begin_ns + state.row_ns
        if state.limit_period_us > 0 and t_us // state.limit_period_us != state.period:
            _end_period(state, out)
            state.period = t_us // state.limit_period_us
        event = heads[row]
        heads[row] = -1
        while event >= 0:
            state.waiting -= 1
            state.came += 1
            if state.limit_period_us == 0 or state.passed < state.limit_events:
                out.keys[n] = (t_us << 22) | (queue.keys[event] & 0x3FFFFF)
                n += 1
                state.passed += 1
            else:
                state.cut += 1
            following = links[event]
            links[event] = heads[heads.size - 1]
            heads[heads.size - 1] = event
            event = following
    out.counts.keys = n


@entry_kernel
def _read_out(requests, until_us, state, queue, out):
    """Pass sorted requests through the arbiter."""
    heads = queue.heads
    served_us = -1
    for request in requests:
        t_us = request >> 22
        if t_us != served_us:
            served_us = t_us
            _serve(t_us, state, queue, out)
        place = heads[heads.size - 1]
        if place < 0:
            _drop(t_us, state, out)
            continue
        heads[heads.size - 1] = queue.links[place]
        row = (request >> 12) & 0x3FF
        if heads[row] < 0:
            at = (state.first + state.queued) % queue.rows.shape[0]
            queue.rows[at, 0], queue.rows[at, 1] = row, t_us
            state.queued += 1
        queue.keys[place] = request
        queue.links[place] = heads[row]
        heads[row] = place
        state.waiting += 1
    _serve(until_us, state, queue, out)
    period_us = state.limit_period_us
    if period_us > 0 and state.period >= 0 and (state.period + 1) * period_us < until_us:
        _end_period(state, out)
