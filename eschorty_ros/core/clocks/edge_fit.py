"""Offset and drift of the sensor's clock from pulses that a stage sends at known positions.

Pulse ``n`` begins as the carriage passes ``first + n interval``. The odometry gives the ROS time of
that, the camera's trigger input the sensor time. An edge is assigned to its pulse by the
approximate clock and, where that is not accurate to a pulse, by the ramps: there the pulses are
further apart in time, and only the right shift of the clock aligns all edges with pulses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import integer_vector
from eschorty_ros.core.base.numbers import SIGMA_PER_MAD, TIME_LIMIT
from eschorty_ros.core.clocks.clock_line import DRIFT_MAX_PPB, NS_PER_US, ClockLine
from eschorty_ros.core.clocks.pulses import PulseTrain
from eschorty_ros.core.clocks.stage_track import StageTrack

EDGES_MIN = 8
# A KBD101 samples its position every 102 us, so an edge is late by half of that on average.
SAMPLING_US = 102
_SPEED_MIN_MM_S = 5.0
# On ramps, linear interpolation of the odometry is not accurate enough.
_STEADY_US = 20_000
_STEADY_SHARE = 0.1
_SHARE_MIN = 0.6
_SHARE_GOOD = 0.97
# Range of the arrivals' lateness that is searched: first of a usual host, then of a slow one.
_NEAR_MS = (-10.0, 30.0)
_FAR_MS = (-10.0, 5_000.0)
_STEP_MS = 1.0
_EDGES_SEARCHED = 100
_SEARCHED_AT_ONCE = 1 << 18
_CANDIDATES = 12
# Cost of a millisecond of lateness, as a share of the interval: it decides where no ramp
# distinguishes the pulses.
_NEAR_COST_PER_MS = 2e-4
_FAR_COST_PER_MS = 1e-7
# Edges this near to a pulse (share of the interval) count as its edges even where the fit omits
# them.
_BELONGS = 0.1
_DRIFT_SIGMA = 20e-6
_NOISE_MM = 0.01
_ITERATIONS = 6


@dataclass(frozen=True, slots=True)
class EdgeFit:
    """Relation of the clocks from the edges."""

    line: ClockLine
    """ROS time, as the odometry's stamps count it, against sensor time."""
    used: int
    spurious: int
    missing: int
    """Edges on the line, edges that fit no pulse, and pulses without an edge between used ones."""
    residual_mm: float
    """Root mean square distance of the used edges from their pulses."""
    first_us: int
    last_us: int
    """Sensor times of the first and the last edge used."""


def fit_edges(
    t_us: NDArray[np.int64], track: StageTrack, pulses: PulseTrain, arrivals: ClockLine
) -> EdgeFit | None:
    """Return the clock that aligns the edges with the pulses.

    - ``t_us``: Shape (n,). Sensor times of the pulses' first edges, in time order.
    - ``track``: Odometry over ROS time, us.
    - ``arrivals``: The clock from the packets' arrivals; late rather than early.

    Returns ``None`` when fewer than 8 edges have a position, too many fit no pulse, or the drift
    is out of its bounds: the edges are then not those of this stage.
    """
    t_us = integer_vector("t_us", t_us, np.int64, -TIME_LIMIT, TIME_LIMIT)
    if t_us.size < EDGES_MIN or pulses.count == 0:
        return None
    match = _Match(t_us, track, pulses, arrivals)
    near = match.best(_NEAR_MS, _NEAR_COST_PER_MS)
    if near is not None and near.used >= _SHARE_GOOD * (near.used + near.spurious):
        return near
    far = match.best(_FAR_MS, _FAR_COST_PER_MS)
    return near if far is None or (near is not None and near.used >= far.used) else far


class _Match:
    """Edges against the pulses under shifts of the clock.

    ``late_ms`` is the lateness of the arrivals' clock.
    """

    def __init__(
        self, t_us: NDArray[np.int64], track: StageTrack, pulses: PulseTrain, arrivals: ClockLine
    ) -> None:
        self._track = track
        self._pulses = pulses
        self._arrivals = arrivals
        # When the controller sampled the position, on average.
        self._all_us = arrivals.to_ns(t_us) // NS_PER_US - SAMPLING_US // 2
        self._t_us = t_us
        stride = -(-t_us.size // _EDGES_SEARCHED)
        self._some_us = self._all_us[::stride] if stride > 1 else self._all_us

    def best(self, span_ms: tuple[float, float], cost_per_ms: float) -> EdgeFit | None:
        """Return the fit at the best shift within a span."""
        late_ms = self._search(span_ms, cost_per_ms)
        return None if late_ms is None else self._fit(late_ms)

    def _search(self, span_ms: tuple[float, float], cost_per_ms: float) -> float | None:
        """Return the shift with most edges on pulses; ``None`` if no edge has a position."""
        late_ms = np.arange(span_ms[0], span_ms[1], self._step_ms())
        rows = max(_SEARCHED_AT_ONCE // self._some_us.size, 1)
        cost = np.concatenate(
            [
                self._off(late_ms[begin : begin + rows]).mean(axis=1)
                for begin in range(0, late_ms.size, rows)
            ]
        )
        inner = cost[1:-1]
        valleys = np.flatnonzero((inner <= cost[:-2]) & (inner <= cost[2:])) + 1
        if valleys.size == 0 or cost[valleys].min() >= 0.25:
            return None
        best = valleys[np.argsort(cost[valleys], kind="stable")[:_CANDIDATES]]
        fine_ms = [self._refined(float(late_ms[k])) for k in best]
        fine_cost = self._off(np.array(fine_ms)).mean(axis=1) + cost_per_ms * np.abs(fine_ms)
        return fine_ms[int(np.argmin(fine_cost))]

    def _refined(self, late_ms: float) -> float:
        for _ in range(3):
            offset_mm, speed = self._state(self._some_us - round(late_ms * 1e3))
            near = np.abs(offset_mm) < 0.25 * self._pulses.interval_mm
            near &= np.abs(speed) > _SPEED_MIN_MM_S
            if not near.any():
                return late_ms
            late_ms += 1e3 * float(np.median(offset_mm[near] / speed[near]))
        return late_ms

    def _off(self, late_ms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return distances from pulses (share of the interval, up to 0.25) by shift and edge."""
        at = self._some_us[None, :] - np.rint(late_ms * 1e3).astype(np.int64)[:, None]
        off = np.abs(self._pulses.offset_mm(self._track.position_mm(at))) / self._pulses.interval_mm
        return np.where(off < 0.25, off, 0.25)

    def _step_ms(self) -> float:
        _, speed = self._state(self._some_us)
        fastest = max(float(np.nanmax(np.abs(speed), initial=0.0)), _SPEED_MIN_MM_S)
        return min(_STEP_MS, 0.15e3 * self._pulses.interval_mm / fastest)

    def _state(self, at_us: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distance from the pulses (mm) and the speed (mm/s) at ROS times."""
        position = self._track.position_mm(at_us)
        ahead = self._track.position_mm(at_us + 1000)
        behind = self._track.position_mm(at_us - 1000)
        return self._pulses.offset_mm(position), (ahead - behind) / 2e-3

    def _steady(self, at_us: NDArray[np.int64], speed: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return where the speed hardly changes."""
        position = self._track.position_mm(at_us)
        ahead = self._track.position_mm(at_us + _STEADY_US) - position
        behind = position - self._track.position_mm(at_us - _STEADY_US)
        change = np.abs(ahead - behind) * (1e6 / _STEADY_US)
        return change < np.maximum(_STEADY_SHARE * np.abs(speed), _SPEED_MIN_MM_S)

    def _fit(self, late_ms: float) -> EdgeFit | None:
        """Return offset and drift by least squares over the edges that fit."""
        late_ns, slope = late_ms * 1e6, 0.0
        middle_us = int(self._t_us[self._t_us.size // 2])
        since_s: NDArray[np.float64] = (self._t_us - middle_us) / 1e6
        limit_mm, noise_mm = 0.25 * self._pulses.interval_mm, _NOISE_MM
        for _ in range(_ITERATIONS):
            late_us = np.rint((late_ns + slope * since_s * 1e9) * 1e-3).astype(np.int64)
            offset_mm, speed = self._state(self._all_us - late_us)
            near = (np.abs(offset_mm) < limit_mm) & (np.abs(speed) > _SPEED_MIN_MM_S)
            if np.count_nonzero(near) < EDGES_MIN:
                return None
            steady = near & self._steady(self._all_us - late_us, speed)
            if np.count_nonzero(steady) < EDGES_MIN // 2:
                steady = near
            by_ns, by_slope = _correction(
                offset_mm[steady], speed[steady], since_s[steady], slope, noise_mm
            )
            late_ns += by_ns
            slope += by_slope
            noise_mm = max(SIGMA_PER_MAD * float(np.median(np.abs(offset_mm[near]))), _NOISE_MM)
            limit_mm = min(4.0 * noise_mm, 0.25 * self._pulses.interval_mm)
        drift_ppb = self._arrivals.drift_ppb - round(slope * 1e9)
        known = ~np.isnan(offset_mm)
        residual_mm = float(np.sqrt(np.mean(offset_mm[near] ** 2)))
        near |= (np.abs(offset_mm) < _BELONGS * self._pulses.interval_mm) & (
            np.abs(speed) > _SPEED_MIN_MM_S
        )
        if abs(drift_ppb) > DRIFT_MAX_PPB or near.sum() < _SHARE_MIN * known.sum():
            return None
        origin_ns = self._arrivals.to_ns(middle_us) - round(late_ns)
        used, missing = self._counted(self._all_us - late_us, offset_mm, near)
        return EdgeFit(
            ClockLine(middle_us, origin_ns, drift_ppb),
            int(used.size),
            int(known.sum() - used.size),
            missing,
            residual_mm,
            int(self._t_us[used[0]]),
            int(self._t_us[used[-1]]),
        )

    def _counted(
        self, at_us: NDArray[np.int64], offset_mm: NDArray[np.float64], near: NDArray[np.bool_]
    ) -> tuple[NDArray[np.intp], int]:
        """Return the edges used, one per pulse passed, and the count of pulses without one."""
        index = np.flatnonzero(near)
        position = self._track.position_mm(at_us[index])
        pulse = self._pulses.nearest(position).astype(np.int64)
        _, speed = self._state(at_us[index])
        # Between two passages of one pulse the carriage goes at least half an interval and back.
        apart_us = 0.5e6 * self._pulses.interval_mm / np.abs(speed)
        kept = [0]
        for k in range(1, index.size):
            before = kept[-1]
            soon = at_us[index[k]] - at_us[index[before]] < apart_us[k]
            if pulse[k] == pulse[before] and soon:
                if abs(offset_mm[index[k]]) < abs(offset_mm[index[before]]):
                    kept[-1] = k
            else:
                kept.append(k)
        chosen = np.array(kept)
        steps = np.abs(np.diff(pulse[chosen]))
        direct_us = steps * 1.5e6 * self._pulses.interval_mm / np.abs(speed[chosen][1:])
        direct = np.diff(at_us[index[chosen]]) < direct_us
        return index[chosen], int(np.clip(steps[direct] - 1, 0, None).sum())


def _correction(
    offset_mm: NDArray[np.float64],
    speed_mm_s: NDArray[np.float64],
    since_s: NDArray[np.float64],
    slope: float,
    noise_mm: float,
) -> tuple[float, float]:
    """Return the further lateness (ns) and slope, with a prior of 20 ppm for the slope."""
    rows = np.column_stack((speed_mm_s, speed_mm_s * since_s)) / noise_mm
    scale = np.array([1e-3, _DRIFT_SIGMA])
    normal = (rows * scale).T @ (rows * scale)
    normal[1, 1] += 1.0
    right = (rows * scale).T @ (offset_mm / noise_mm)
    right[1] -= slope / _DRIFT_SIGMA
    late_s, by_slope = np.linalg.solve(normal, right) * scale
    return float(late_s) * 1e9, float(by_slope)
