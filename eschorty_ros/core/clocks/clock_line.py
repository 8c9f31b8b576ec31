"""A straight relation between two clocks, exact in whole numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import times
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer

NS_PER_US = 1_000
DRIFT_MAX_PPB = 200_000
Time = TypeVar("Time", int, NDArray[np.int64])
T_US_LIMIT = TIME_LIMIT // NS_PER_US
_PPB_TIMES_US = 1_000_000
# Each iteration reduces the error to 2e-4 of it, the largest drift.
_ITERATIONS = 8


@dataclass(frozen=True, slots=True)
class ClockLine:
    """ROS time as a straight function of sensor time.

    ``ns = origin_ns + (t - origin_us) 1000 (1 + drift_ppb 1e-9)``, rounded down to the nanosecond
    from exact integers, so its precision does not depend on the uptime. Strictly increasing.

    Raises ``ArgumentError`` when a value is outside its range.
    """

    origin_us: int
    origin_ns: int
    """Sensor time (us) and ROS time (ns) at one instant."""
    drift_ppb: int = 0
    """How much more ROS time passes than sensor time, parts in 10^9; within 200 000."""

    def __post_init__(self) -> None:
        integer("origin_us", self.origin_us, -T_US_LIMIT, T_US_LIMIT)
        integer("origin_ns", self.origin_ns, -TIME_LIMIT, TIME_LIMIT)
        integer("drift_ppb", self.drift_ppb, -DRIFT_MAX_PPB, DRIFT_MAX_PPB)

    def to_ns(self, t_us: Time) -> Time:
        """Return the ROS time (ns) of sensor time ``t_us``; scalar in, ``int`` out."""
        if isinstance(t_us, np.ndarray):
            reach_us = self._reach_us
            low = max(-T_US_LIMIT, self.origin_us - reach_us)
            high = min(T_US_LIMIT, self.origin_us + reach_us)
            since = _within("t_us", t_us, low, high) - self.origin_us
            return self._elapsed_ns(since) + self.origin_ns
        since_us = integer("t_us", t_us, -T_US_LIMIT, T_US_LIMIT) - self.origin_us
        return int(self._elapsed_ns(since_us)) + self.origin_ns

    def to_us(self, t_ns: Time) -> Time:
        """Return the sensor time (us, nearest, halves up) of ROS time ``t_ns``."""
        if isinstance(t_ns, np.ndarray):
            return self._since_us(_within("t_ns", t_ns, -TIME_LIMIT, TIME_LIMIT) - self.origin_ns)
        return int(self._since_us(integer("t_ns", t_ns, -TIME_LIMIT, TIME_LIMIT) - self.origin_ns))

    def shifted(self, by_ns: int) -> ClockLine:
        """Return the line shifted by ``by_ns`` of ROS time."""
        by_ns = integer("by_ns", by_ns, -2 * TIME_LIMIT, 2 * TIME_LIMIT)
        return ClockLine(self.origin_us, self.origin_ns + by_ns, self.drift_ppb)

    @property
    def _reach_us(self) -> int:
        """Longest time from the origin whose conversion fits into 64 bits."""
        return T_US_LIMIT // 2 if self.drift_ppb else 2 * T_US_LIMIT

    # The arguments of both are an int or an array of int64.

    def _elapsed_ns(self, since_us: Any) -> Any:
        if not self.drift_ppb:
            return since_us * NS_PER_US
        # In two steps, as the product of both would exceed 64 bits.
        millions, rest = since_us // _PPB_TIMES_US, since_us % _PPB_TIMES_US
        late = millions * self.drift_ppb + rest * self.drift_ppb // _PPB_TIMES_US
        return since_us * NS_PER_US + late

    def _since_us(self, since_ns: Any) -> Any:
        found = (since_ns + NS_PER_US // 2) // NS_PER_US
        for _ in range(_ITERATIONS if self.drift_ppb else 0):
            left = since_ns - self._elapsed_ns(found)
            found = found + (left + NS_PER_US // 2) // NS_PER_US
        return found + self.origin_us


def _within(name: str, values: NDArray[np.int64], low: int, high: int) -> NDArray[np.int64]:
    """Return ``values`` as int64; refuse those that would exceed 64 bits when converted."""
    checked = times(name, values)
    for extreme in (checked.max(), checked.min()) if checked.size else ():
        if not low <= extreme <= high:
            raise ArgumentError(f"{name} holds {extreme}; choose {low} to {high}")
    return checked
