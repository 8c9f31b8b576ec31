"""How events leave the sensor: row by row, at a limited rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.simulation._readout_kernels import (
    S_DROPPED,
    S_NOTES,
    S_SIZE,
    S_TOLD,
    S_WAITING,
    _read_out,
)

ERC_PERIOD_US = 1000
"""The rate limit counts events over this long."""


@dataclass(frozen=True, slots=True)
class ReadoutParameters:
    """Parameters of the readout; a model, the sensor's are not published.

    Parameters
    ----------
    row_time_us : float
        Time the arbiter spends on one row, however many events that has.
    waiting_max : int
        Events that may wait for the arbiter; more are dropped.
    rate_max_hz : float
        Events per second that leave the sensor, kept over ``ERC_PERIOD_US``; the rest of a
        period's events are dropped. ``inf`` for no limit.

    Raises
    ------
    ArgumentError
        For a value outside its range.
    """

    row_time_us: float = 0.5
    waiting_max: int = 1 << 17
    rate_max_hz: float = math.inf

    def __post_init__(self) -> None:
        if not 1e-3 <= self.row_time_us <= 1e6:
            raise ArgumentError(f"row_time_us is {self.row_time_us!r}; choose 0.001 to 1e6")
        if not 1 <= self.waiting_max <= 1 << 24:
            raise ArgumentError(f"waiting_max is {self.waiting_max!r}; choose 1 to {1 << 24}")
        if not self.rate_max_hz * ERC_PERIOD_US >= 1e6:
            least = 1e6 / ERC_PERIOD_US
            raise ArgumentError(f"rate_max_hz is {self.rate_max_hz!r}; choose {least:g} or more")


class Readout:
    """The row arbiter: rows queue up in the order they ask, and are read out whole.

    All events of a row that wait when its turn comes share the time of the readout; a pixel that
    asked twice by then is read once, which ``merged`` counts. Same requests, same events, however
    the calls are spaced.

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
        unlimited = math.isinf(p.rate_max_hz)
        self._window_events = 2**62 if unlimited else int(p.rate_max_hz * ERC_PERIOD_US * 1e-6)
        self._state = np.zeros(S_SIZE, dtype=np.int64)
        self._state[S_TOLD] = -1
        self._queue = np.empty((rows, 2), dtype=np.int64)
        # Per row the last event that waits, and last of all the first free place.
        self._heads = np.append(np.full(rows, -1), 0)
        self._links = np.append(np.arange(1, p.waiting_max), -1)
        self._keys = np.empty(p.waiting_max, dtype=np.int64)

    @property
    def dropped(self) -> int:
        """Events lost so far."""
        return int(self._state[S_DROPPED])

    def read_out(
        self, requests: NDArray[np.int64], until_us: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pass on events as they are read out.

        Parameters
        ----------
        requests : ndarray of int64
            All event keys of :meth:`PixelArray.take` up to ``until_us`` not given before, sorted.
        until_us : int

        Returns
        -------
        keys : ndarray of int64
            Events read out before ``until_us``, sorted.
        drops_us : ndarray of int64
            Times at which the sensor tells that it drops events: once per ``ERC_PERIOD_US``.
        """
        events_max = requests.size + int(self._state[S_WAITING])
        out = np.empty(events_max, dtype=np.int64)
        drops = np.empty(events_max, dtype=np.int64)
        n = _read_out(
            requests,
            until_us,
            self._row_ns,
            ERC_PERIOD_US,
            self._window_events,
            self._state,
            self._queue,
            self._heads,
            self._links,
            self._keys,
            out,
            drops,
        )
        keys = out[:n]
        keys.sort()
        # Sorting and comparing is ten times as fast here as np.unique, which hashes.
        fresh = np.append(True, keys[1:] != keys[:-1])[:n]
        if not fresh.all():
            keys = keys[fresh]
            self.merged += n - keys.size
        return keys, drops[: self._state[S_NOTES]]
