"""A clock from arrivals with one-sided delays: the line below all of them.

A packet may be late by any time, but never early. The relation of the clocks is therefore the line
below all points (sensor time, arrival) that touches those without delay: an edge of their lower
convex hull (Moon, Skelly, Towsley: Estimation and removal of clock skew from network delay
measurements, INFOCOM 1999).
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.numbers import TIME_LIMIT, integer
from eschorty_ros.core.clocks.clock_line import DRIFT_MAX_PPB, NS_PER_US, ClockLine

_BINS = 600
# Points further above the line are late because of the host and do not count.
_PROMPT_NS = 5e6
# A fit costs as much as the window has points: one for each share of them that is new.
_POINTS_PER_FIT = 1 / 50
# The cost of a drift is its amount over this span, so that short windows have none.
_DRIFT_COST_SPAN_US = 1e6


class LowerEnvelope:
    """Offset and drift from packets whose arrival is late by an unknown time of 0 or more.

    Of each bin of sensor time only the earliest arrival is kept. Of the hull's edges with a drift
    within 200 ppm the one nearest to most points is chosen: all points more than 5 ms above it
    count the same, so a host that lags for seconds neither shifts nor tilts the line as long as
    the window contains some packets without delay.

    - ``window_ns``: Length of the sliding window, ns of arrival time.

    Public attributes:
    - ``line``: Never above a point observed since the last fit.
    - ``touched_us``: Sensor time of the newest point on the line.
    """

    def __init__(self, window_ns: int) -> None:
        self._window_ns = integer("window_ns", window_ns, 1, TIME_LIMIT)
        self._bin_us = max(window_ns // (NS_PER_US * _BINS), 1)
        # Number of the bin, sensor time, arrival.
        self._points: deque[tuple[int, int, int]] = deque()
        self._new_points = 0
        self.line: ClockLine | None = None
        self.touched_us = 0

    def __len__(self) -> int:
        """Return the count of points in the window."""
        return len(self._points)

    def observe(self, t_us: int, arrival_ns: int) -> None:
        """Add the arrival of the event of sensor time ``t_us``; times must not go back."""
        points = self._points
        bin_ = t_us // self._bin_us
        if not points or points[-1][0] != bin_:
            points.append((bin_, t_us, arrival_ns))
            self._new_points += 1
        elif arrival_ns - points[-1][2] < (t_us - points[-1][1]) * NS_PER_US:
            points[-1] = (bin_, t_us, arrival_ns)
        while len(points) > 1 and points[0][2] < arrival_ns - self._window_ns:
            points.popleft()
        if self.line is None or self._new_points > len(points) * _POINTS_PER_FIT:
            self.line = self._fit()
            self._new_points = 0
        late_ns = arrival_ns - self.line.to_ns(t_us)
        if late_ns <= 0:
            self.line = self.line.shifted(late_ns)
            self.touched_us = t_us

    def _fit(self) -> ClockLine:
        _, t, arrival = np.array(self._points, dtype=np.int64).T
        since_us = (t - t[0]).astype(np.float64)
        late_ns = ((arrival - arrival[0]) - (t - t[0]) * NS_PER_US).astype(np.float64)
        drift_ppb = _drift_ppb(since_us, late_ns)
        line = ClockLine(int(t[-1]), int(arrival[-1]), drift_ppb)
        above = arrival - line.to_ns(t)
        lowest = int(above.min())
        self.touched_us = int(t[np.flatnonzero(above == lowest)[-1]])
        return line.shifted(lowest)


def _drift_ppb(since_us: NDArray[np.float64], late_ns: NDArray[np.float64]) -> int:
    """Return the drift of the hull's edge nearest to most points, within its bounds."""
    corners = _lower_hull(since_us, late_ns)
    slopes = np.diff(late_ns[corners]) / np.diff(since_us[corners])
    # ns per us is 10^-3.
    ppb = np.rint(np.concatenate(([0.0, -DRIFT_MAX_PPB, DRIFT_MAX_PPB], slopes * 1e6)))
    ppb = ppb[np.abs(ppb) <= DRIFT_MAX_PPB]
    above = late_ns - ppb[:, None] * 1e-6 * since_us
    above -= above.min(axis=1, keepdims=True)
    # Weighed by the share of prompt points, as their distances are.
    drift_cost_ns = np.abs(ppb) * 1e-6 * _DRIFT_COST_SPAN_US * (above < _PROMPT_NS).mean(axis=1)
    return int(ppb[np.argmin(np.minimum(above, _PROMPT_NS).mean(axis=1) + drift_cost_ns)])


def _lower_hull(x: NDArray[np.float64], y: NDArray[np.float64]) -> list[int]:
    """Return the corners of the lower convex hull; ``x`` must not fall."""
    xs, ys = x.tolist(), y.tolist()
    hull: list[int] = []
    for k in range(len(xs)):
        while hull and xs[hull[-1]] == xs[k] and ys[hull[-1]] >= ys[k]:
            hull.pop()
        if hull and xs[hull[-1]] == xs[k]:
            continue
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            turn = (xs[b] - xs[a]) * (ys[k] - ys[a]) - (ys[b] - ys[a]) * (xs[k] - xs[a])
            if turn > 0:
                break
            hull.pop()
        hull.append(k)
    return hull
