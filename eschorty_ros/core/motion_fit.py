"""A stage's motion from encoder readings that arrive late: position as a function of time.

A reading is exact in place and vague in time: it was taken after it was asked for and before it
arrived. The motion is known but for when it began: pieces of constant acceleration. Each reading
bounds the beginning from both sides, and many readings settle it far better than their delays
spread. Where the motion is not known, or does not fit, positions lie on lines between readings.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core._checks import TIME_LIMIT, number, positive, times, whole
from eschorty_ros.core._motion_legs import Leg, Move, Reading, Stop, Unknown
from eschorty_ros.core._motion_timing import Delays
from eschorty_ros.core.clock import POSITION_LIMIT_MM
from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.motion import MotionPlan

_LEGS_MAX = 64
_READINGS_MAX = 10_000


class MotionFit:
    """Readings of the encoder joined with the motions that were ordered.

    All times are int64 nanoseconds of one clock. Not thread-safe.

    Parameters
    ----------
    tolerance_mm : float
        How far the carriage may lie beside its ordered motion; also when it counts as resting.

    Attributes
    ----------
    late_readings : int
        Readings not later than the one before, which were not used.
    """

    def __init__(self, tolerance_mm: float = 1e-3) -> None:
        self._tolerance_mm = positive("tolerance_mm", tolerance_mm)
        self.late_readings = 0
        self._at_ns: list[int] = []
        self._places: list[float] = []
        self._legs: list[Leg] = [Unknown(-TIME_LIMIT)]
        self._delays = Delays()

    @property
    def until_ns(self) -> int | None:
        """Time up to which positions are known; ``None`` before the first reading."""
        return self._at_ns[-1] if self._at_ns else None

    @property
    def residual_mm(self) -> float:
        """How far readings lie outside the motion under way, root mean square; NaN if unknown."""
        return self._legs[-1].residual_mm

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the position at full speed; NaN if unknown."""
        return self._legs[-1].sigma_mm

    @property
    def strays(self) -> int:
        """Readings that contradict the motion under way."""
        return self._legs[-1].strays

    def observe(self, position_mm: float, latest_ns: int, earliest_ns: int | None = None) -> None:
        """Add one reading.

        Parameters
        ----------
        position_mm : float
        latest_ns, earliest_ns : int
            When it can have been taken at the latest (receipt, less the line's own time) and at
            the earliest (request).

        Raises
        ------
        ArgumentError
            When a value is not finite or the earliest lies after the latest.
        """
        number("position_mm", position_mm, -POSITION_LIMIT_MM, POSITION_LIMIT_MM)
        latest_ns = whole("latest_ns", latest_ns, -TIME_LIMIT, TIME_LIMIT)
        if earliest_ns is not None:
            earliest_ns = whole("earliest_ns", earliest_ns, -TIME_LIMIT, TIME_LIMIT)
            if earliest_ns > latest_ns:
                raise ArgumentError(
                    f"earliest_ns is {earliest_ns}, after latest_ns {latest_ns}; swap them"
                )
        reading = Reading(float(position_mm), earliest_ns, latest_ns)
        if self._at_ns and reading.middle_ns <= self._at_ns[-1]:
            self.late_readings += 1
            return
        self._at_ns.append(reading.middle_ns)
        self._places.append(reading.position_mm)
        if len(self._at_ns) > 2 * _READINGS_MAX:
            del self._at_ns[:_READINGS_MAX], self._places[:_READINGS_MAX]
        self._legs[-1].add(reading)

    def follow(self, plan: MotionPlan) -> None:
        """Expect ``plan``, from rest to rest, to begin at its ``start_ns`` or soon after."""
        self._begin(Move(plan, self._tolerance_mm, self._delays))

    def stop(self, at_ns: int, deceleration_mm_s2: float) -> None:
        """Expect the motion under way to end in a ramp that begins at ``at_ns`` or soon after."""
        positive("deceleration_mm_s2", deceleration_mm_s2)
        whole("at_ns", at_ns, -TIME_LIMIT, TIME_LIMIT)
        before = self._legs[-1].plan()
        if before is None:
            self.wander(at_ns)
        elif at_ns < before.end_ns:
            self._begin(Stop(before, at_ns, deceleration_mm_s2, self._tolerance_mm))

    def wander(self, at_ns: int) -> None:
        """Expect nothing from ``at_ns`` on."""
        self._begin(Unknown(whole("at_ns", at_ns, -TIME_LIMIT, TIME_LIMIT)))

    def doubt(self) -> None:
        """Believe the readings alone for the motion under way."""
        self._legs[-1] = Unknown(self._legs[-1].from_ns)

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        """Lowest and highest position of a reading between two times; ``None`` if unknown."""
        for name, value in (("earliest_ns", earliest_ns), ("latest_ns", latest_ns)):
            whole(name, value, -TIME_LIMIT, TIME_LIMIT)
        return self._legs[-1].expected_mm(earliest_ns, latest_ns)

    def state(self, t_ns: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position (mm) and velocity (mm/s) at integer times ``t_ns``, same shape as ``t_ns``.

        Beyond :attr:`until_ns` the ordered motion is trusted, or the last reading held.

        Raises
        ------
        ArgumentError
            Before the first reading.
        """
        wanted = times("t_ns", t_ns)
        if not self._at_ns:
            raise ArgumentError("the position is unknown; observe a reading first")
        flat = wanted.reshape(-1)
        position, velocity = np.empty(flat.shape), np.empty(flat.shape)
        begins = [leg.from_ns for leg in self._legs]
        which = np.array([bisect_right(begins, int(t)) - 1 for t in flat], dtype=np.intp)
        for index in np.unique(which):
            chosen = which == index
            plan = self._legs[index].plan()
            if plan is None:
                position[chosen], velocity[chosen] = self._between(int(index), flat[chosen])
            else:
                position[chosen], velocity[chosen] = plan.state(flat[chosen])
        return position.reshape(wanted.shape), velocity.reshape(wanted.shape)

    def _between(
        self, index: int, t_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions on lines between the readings of a leg, and the known motions beside it."""
        begin_ns = self._legs[index].from_ns
        end_ns = self._legs[index + 1].from_ns if index + 1 < len(self._legs) else TIME_LIMIT
        before = self._legs[index - 1].plan() if index else None
        after = self._legs[index + 1].plan() if index + 1 < len(self._legs) else None
        # Beside another unknown leg its readings count, too.
        low = bisect_right(self._at_ns, begin_ns) if before is not None else 0
        high = bisect_left(self._at_ns, end_ns) if after is not None else len(self._at_ns)
        # No more of them than the times asked for need.
        first = max(bisect_right(self._at_ns, int(t_ns.min()), low, max(low, high)) - 1, low)
        last = bisect_left(self._at_ns, int(t_ns.max()), first, max(first, high)) + 1
        chosen = slice(first, min(last, high))
        knots = list(zip(self._at_ns[chosen], self._places[chosen], strict=True))
        if before is not None and first == low:
            knots.insert(0, (begin_ns, float(before.state(begin_ns)[0])))
        if after is not None and last >= high:
            knots.append((end_ns, float(after.state(end_ns)[0])))
        at_s = np.array([at_ns - knots[0][0] for at_ns, _ in knots]) * 1e-9
        places = np.array([place for _, place in knots])
        wanted_s = (np.clip(t_ns, -TIME_LIMIT, TIME_LIMIT) - knots[0][0]) * 1e-9
        position = np.interp(wanted_s, at_s, places)
        if len(knots) < 2:
            return position, np.zeros_like(position)
        slopes = np.diff(places) / np.maximum(np.diff(at_s), 1e-9)
        piece = np.clip(np.searchsorted(at_s, wanted_s) - 1, 0, len(slopes) - 1)
        inside = (wanted_s >= at_s[0]) & (wanted_s <= at_s[-1])
        return position, np.where(inside, slopes[piece], 0.0)

    def _begin(self, leg: Leg) -> None:
        last = self._legs[-1]
        if isinstance(last, Move) and last.plan() is not None:
            self._delays = last.delays
        self._legs.append(leg)
        del self._legs[:-_LEGS_MAX]
