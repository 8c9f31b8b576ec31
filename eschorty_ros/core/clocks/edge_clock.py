"""The sensor's clock from a stage's trigger edges, as they arrive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.numbers import TIME_LIMIT
from eschorty_ros.core.clocks.clock_line import NS_PER_US, ClockLine
from eschorty_ros.core.clocks.edge_fit import EdgeFit, fit_edges
from eschorty_ros.core.clocks.pulses import PulseTrain, checked_edges, leading_edges
from eschorty_ros.core.clocks.stage_track import StageTrack

_WINDOW_US = 60_000_000
_EDGES_MAX = 8192
_REFIT_US = 50_000


class EdgeClock:
    """The edges of the last minute, fitted whenever the odometry covers new ones.

    Public attributes:
    - ``fit``: The last successful fit.
    - ``pulses``: The pulses that the stage sends; without them no fit is made.
    - ``edges_dropped``: Edges dropped because more than 8192 came in the last minute, faster than
      from a stage.
    """

    def __init__(self, pulses: PulseTrain | None) -> None:
        self.fit: EdgeFit | None = None
        self.pulses = pulses
        self.edges_dropped = 0
        self._t_us = np.empty(0, np.int64)
        self._polarity = np.empty(0, np.uint8)
        self._fitted_us: int | None = None

    def __len__(self) -> int:
        """Return the count of edges kept, of both kinds."""
        return self._t_us.size

    @property
    def until_us(self) -> int | None:
        """Sensor time of the last edge used, ``None`` without a fit."""
        return self.fit.last_us if self.fit is not None else None

    def add(self, t_us: NDArray[np.int64], polarity: NDArray[np.uint8]) -> None:
        """Append edges of the trigger input, in time order; 1 for rising ones."""
        t_us, polarity = checked_edges(t_us, polarity)
        if t_us.size == 0:
            return
        t_us = np.concatenate([self._t_us, t_us])
        begin = int(np.searchsorted(t_us, t_us[-1] - _WINDOW_US))
        excess = t_us.size - begin - _EDGES_MAX
        if excess > 0:
            self.edges_dropped += excess
            begin += excess
        self._t_us = t_us[begin:]
        self._polarity = np.concatenate([self._polarity, polarity])[begin:]

    def update(self, track: StageTrack, arrivals: ClockLine, *, now: bool = False) -> bool:
        """Fit again when there are new edges; return whether ``fit`` has changed.

        - ``track``: Odometry over ROS time, us.
        - ``arrivals``: The clock from the packets' arrivals.
        - ``now``: Fit as soon as there is a new edge, not only after 50 ms of them.
        """
        last_us = track.last_us
        if self.pulses is None or last_us is None or self._t_us.size == 0:
            return False
        newest = int(np.searchsorted(self._t_us, arrivals.to_us(last_us * NS_PER_US), side="right"))
        if newest == 0:
            return False
        newest_us = int(self._t_us[newest - 1])
        since_us = newest_us - self._fitted_us if self._fitted_us is not None else TIME_LIMIT
        if since_us < (1 if now else _REFIT_US):
            return False
        self._fitted_us = newest_us
        leading_us = leading_edges(self._t_us[:newest], self._polarity[:newest])
        fit = fit_edges(leading_us, track, self.pulses, arrivals)
        if fit is not None:
            self.fit = fit
        return fit is not None
