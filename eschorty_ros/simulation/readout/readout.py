"""How events leave the sensor: row by row, and at a limited rate when that is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.simulation.readout._readout import (
    S_CAME,
    S_CUT,
    S_DROPPED,
    S_NOTES,
    S_PASSED,
    S_PERIOD,
    S_PERIODS,
    S_SIZE,
    S_TOLD,
    S_WAITING,
    _read_out,
)

DROP_NOTE_US = 1000
"""The sensor says at most once in so long that its readout drops events."""


@dataclass(frozen=True, slots=True)
class EventRate:
    """Limit of the event-rate control.

    Parameters
    ----------
    events : int
        The first so many events of every period leave the sensor; the others are dropped.
    period_us : int

    Raises
    ------
    ArgumentError
        For a value outside its range.
    """

    events: int
    period_us: int

    def __post_init__(self) -> None:
        if self.events < 0:
            raise ArgumentError(f"events is {self.events!r}; choose 0 or more")
        if self.period_us < 1:
            raise ArgumentError(f"period_us is {self.period_us!r}; choose 1 or more")


@dataclass(frozen=True, slots=True)
class ReadoutParameters:
    """Parameters of the readout; a model, the sensor's are not published.

    Parameters
    ----------
    row_time_us : float
        Time the arbiter spends on one row, however many events that has.
    waiting_max : int
        Events that may wait for the arbiter; more are dropped.

    Raises
    ------
    ArgumentError
        For a value outside its range.
    """

    row_time_us: float = 0.5
    waiting_max: int = 1 << 17

    def __post_init__(self) -> None:
        if not 1e-3 <= self.row_time_us <= 1e6:
            raise ArgumentError(f"row_time_us is {self.row_time_us!r}; choose 0.001 to 1e6")
        if not 1 <= self.waiting_max <= 1 << 24:
            raise ArgumentError(f"waiting_max is {self.waiting_max!r}; choose 1 to {1 << 24}")


class ReadOut(NamedTuple):
    """What left the sensor.

    Attributes
    ----------
    keys : ndarray of int64
        Events, sorted.
    drops_us : ndarray of int64
        Times at which the sensor tells that its readout is full: once per ``DROP_NOTE_US``.
    periods : ndarray of int64, shape (n, 3)
        Periods of the rate control that had events: their end (us), events before and after it.
    """

    keys: NDArray[np.int64]
    drops_us: NDArray[np.int64]
    periods: NDArray[np.int64]


class Readout:
    """The row arbiter: rows queue up in the order they ask, and are read out whole.

    All events of a row that wait when its turn comes share the time of the readout; a pixel that
    asked twice by then is read once, which ``merged`` counts. Behind it the event-rate control,
    off until :meth:`limit`. Same requests, same events, however the calls are spaced.

    Parameters
    ----------
    rows : int
        Height of the sensor.
    parameters : ReadoutParameters
    """

    def __init__(self, rows: int, parameters: ReadoutParameters | None = None) -> None:
        p = parameters or ReadoutParameters()
        self.merged = 0
        self._row_ns = round(p.row_time_us * 1000)
        self._rate: EventRate | None = None
        self._cut_short = np.empty((0, 3), dtype=np.int64)
        self._state = np.zeros(S_SIZE, dtype=np.int64)
        self._state[S_TOLD] = self._state[S_PERIOD] = -1
        self._queue = np.empty((rows, 2), dtype=np.int64)
        # Per row the last event that waits, and last of all the first free place.
        self._heads = np.append(np.full(rows, -1), 0)
        self._links = np.append(np.arange(1, p.waiting_max), -1)
        self._keys = np.empty(p.waiting_max, dtype=np.int64)

    @property
    def dropped(self) -> int:
        """Events lost so far because too many waited."""
        return int(self._state[S_DROPPED])

    @property
    def rate_dropped(self) -> int:
        """Events the rate control has dropped so far."""
        return int(self._state[S_CUT])

    def limit(self, t_us: int, rate: EventRate | None) -> None:
        """Limit the rate from ``t_us`` on, up to which everything has been read out.

        ``None`` lets everything through. The period under way ends.
        """
        state = self._state
        if self._rate is not None and state[S_CAME]:
            ended = np.array([[t_us, state[S_CAME], state[S_PASSED]]])
            self._cut_short = np.concatenate((self._cut_short, ended))
        state[S_CAME], state[S_PASSED], state[S_PERIOD] = 0, 0, -1
        self._rate = rate

    def read_out(self, requests: NDArray[np.int64], until_us: int) -> ReadOut:
        """Pass on events as they are read out before ``until_us``.

        Parameters
        ----------
        requests : ndarray of int64
            All event keys of :meth:`PixelArray.take` up to ``until_us`` not given before, sorted.
        until_us : int
        """
        events_max = requests.size + int(self._state[S_WAITING])
        out = np.empty(events_max, dtype=np.int64)
        drops = np.empty(requests.size, dtype=np.int64)
        rate = self._rate
        periods = np.empty((events_max + 1 if rate else 0, 3), dtype=np.int64)
        n = _read_out(
            requests,
            until_us,
            self._row_ns,
            rate.period_us if rate else 0,
            rate.events if rate else 0,
            DROP_NOTE_US,
            self._state,
            self._queue,
            self._heads,
            self._links,
            self._keys,
            out,
            drops,
            periods,
        )
        keys = out[:n]
        keys.sort()
        # Sorting and comparing is ten times as fast here as np.unique, which hashes.
        fresh = np.append(True, keys[1:] != keys[:-1])[:n]
        if not fresh.all():
            keys = keys[fresh]
            self.merged += n - keys.size
        periods = periods[: self._state[S_PERIODS]]
        if self._cut_short.size:
            periods = np.concatenate((self._cut_short, periods))
            self._cut_short = self._cut_short[:0]
        return ReadOut(keys, drops[: self._state[S_NOTES]], periods)
