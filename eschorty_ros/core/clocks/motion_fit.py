"""Position of a stage over time, from encoder readings that arrive late.

The position of a reading is exact and its time uncertain: it was taken after its request and before
its receipt. The ordered motion, pieces of constant acceleration, is known except for its start.
Each reading bounds the start from both sides, so that many readings determine it to far less than
the spread of their delays. Where the motion is unknown, or contradicts the readings, positions are
interpolated linearly between readings.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from statistics import median

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array, times
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer, number, positive
from eschorty_ros.core.clocks.motion import MotionPlan
from eschorty_ros.core.clocks.motion_leg import Leg, Move, Reading, Stop
from eschorty_ros.core.clocks.motion_start import Delays
from eschorty_ros.core.clocks.stage_track import POSITION_LIMIT_MM

_LEGS_MAX = 64
_READINGS_MAX = 10_000
# Readings whose usual spread between request and receipt is that of a host that keeps up.
_USUAL_READINGS = 32
# A motion whose start is bounded less well than by two usual readings is not yet known.
_USUAL_SPREADS = 2


class MotionFit:
    """Position over time, from readings of the encoder and the motions that were ordered.

    All times are int64 nanoseconds of one clock. Not thread-safe.

    - ``tolerance_mm``: Largest deviation of the carriage from its ordered motion, and from rest.

    Public attributes:
    - ``late_readings``: Readings not later than the one before, which were not used.
    """

    def __init__(self, tolerance_mm: float = 1e-3) -> None:
        self._tolerance_mm = positive("tolerance_mm", tolerance_mm)
        self.late_readings = 0
        self._at_ns: list[int] = []
        self._positions: list[float] = []
        self._until_ns: int | None = None
        self._spreads_ns: deque[int] = deque(maxlen=_USUAL_READINGS)
        self._legs = [Leg(-TIME_LIMIT)]
        self._delays = Delays()

    @property
    def until_ns(self) -> int | None:
        """Time up to which positions are known; ``None`` before the first reading.

        After a stall of host or controller it stays where the motion under way can have begun
        until a reading of usual delay, or the motion's end, shows when it did.
        """
        return self._until_ns

    @property
    def residual_mm(self) -> float:
        """Root mean square deviation of readings from the motion under way; NaN if unknown."""
        return self._legs[-1].residual_mm

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the position at full speed; NaN if unknown."""
        return self._legs[-1].sigma_mm

    @property
    def outliers(self) -> int:
        """Readings that contradict the motion under way."""
        return self._legs[-1].outliers

    def add_reading(
        self, position_mm: float, latest_ns: int, earliest_ns: int | None = None
    ) -> None:
        """Add one reading.

        - ``latest_ns``, ``earliest_ns``: Bounds of the time at which it was taken: its receipt,
          less the transfer time of the serial line, and its request.

        Raises ``ArgumentError`` when a value is not finite or the earliest time is after the
        latest.
        """
        number("position_mm", position_mm, -POSITION_LIMIT_MM, POSITION_LIMIT_MM)
        latest_ns = integer("latest_ns", latest_ns, -TIME_LIMIT, TIME_LIMIT)
        if earliest_ns is not None:
            earliest_ns = integer("earliest_ns", earliest_ns, -TIME_LIMIT, TIME_LIMIT)
            if earliest_ns > latest_ns:
                raise ArgumentError(
                    f"earliest_ns is {earliest_ns}, after latest_ns {latest_ns}; swap them"
                )
        reading = Reading(float(position_mm), earliest_ns, latest_ns)
        if self._at_ns and reading.middle_ns <= self._at_ns[-1]:
            self.late_readings += 1
            return
        self._at_ns.append(reading.middle_ns)
        self._positions.append(reading.position_mm)
        if earliest_ns is not None:
            self._spreads_ns.append(latest_ns - earliest_ns)
        if len(self._at_ns) > 2 * _READINGS_MAX:
            del self._at_ns[:_READINGS_MAX], self._positions[:_READINGS_MAX]
        self._legs[-1].add(reading)
        self._until_ns = self._known_until_ns()

    def _known_until_ns(self) -> int:
        """Return the time up to which positions are known now, not before the last one returned."""
        until_ns = self._at_ns[-1]
        if self._spreads_ns:
            spread_ns = _USUAL_SPREADS * median(self._spreads_ns)
            until_ns = min(until_ns, self._legs[-1].known_until_ns(spread_ns))
        return until_ns if self._until_ns is None else max(until_ns, self._until_ns)

    def expect_move(self, plan: MotionPlan) -> None:
        """Expect ``plan``, from rest to rest, to begin at its ``start_ns`` or soon after."""
        self._begin(Move(plan, self._tolerance_mm, self._delays))

    def expect_stop(self, at_ns: int, deceleration_mm_s2: float) -> None:
        """Expect the motion under way to end in a ramp that begins at ``at_ns`` or soon after."""
        positive("deceleration_mm_s2", deceleration_mm_s2)
        integer("at_ns", at_ns, -TIME_LIMIT, TIME_LIMIT)
        before = self._legs[-1].plan()
        if before is None:
            self.expect_unknown(at_ns)
        elif at_ns < before.end_ns:
            self._begin(Stop(before, at_ns, deceleration_mm_s2, self._tolerance_mm))

    def expect_unknown(self, at_ns: int) -> None:
        """Use readings alone from ``at_ns`` on."""
        self._begin(Leg(integer("at_ns", at_ns, -TIME_LIMIT, TIME_LIMIT)))

    def discard_motion(self) -> None:
        """Use readings alone for the motion under way."""
        self._legs[-1] = Leg(self._legs[-1].from_ns)

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        """Return the lowest and highest position between two times; ``None`` if unknown."""
        for name, value in (("earliest_ns", earliest_ns), ("latest_ns", latest_ns)):
            integer(name, value, -TIME_LIMIT, TIME_LIMIT)
        return self._legs[-1].expected_mm(earliest_ns, latest_ns)

    def state(self, t_ns: ArrayLike) -> tuple[Array, Array]:
        """Return position (mm) and velocity (mm/s) at integer times ``t_ns``, in its shape.

        Beyond :attr:`until_ns` they follow the ordered motion, or hold the last reading.

        Raises ``ArgumentError`` before the first reading.
        """
        at_ns = times("t_ns", t_ns)
        if not self._at_ns:
            raise ArgumentError("the position is unknown; add a reading first")
        flat = at_ns.reshape(-1)
        position, velocity = np.empty(flat.shape), np.empty(flat.shape)
        begins = np.array([leg.from_ns for leg in self._legs])
        which = np.maximum(np.searchsorted(begins, flat, side="right") - 1, 0)
        for index in np.unique(which):
            chosen = which == index
            plan = self._legs[index].plan()
            if plan is None:
                position[chosen], velocity[chosen] = self._between(int(index), flat[chosen])
            else:
                position[chosen], velocity[chosen] = plan.state(flat[chosen])
        return position.reshape(at_ns.shape), velocity.reshape(at_ns.shape)

    def _between(self, index: int, t_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return states interpolated between a leg's readings and the known motions beside it."""
        legs = self._legs
        begin_ns = legs[index].from_ns
        end_ns = legs[index + 1].from_ns if index + 1 < len(legs) else TIME_LIMIT
        before = legs[index - 1].plan() if index else None
        after = legs[index + 1].plan() if index + 1 < len(legs) else None
        # Beside another unknown leg its readings count, too.
        low = bisect_right(self._at_ns, begin_ns) if before is not None else 0
        high = bisect_left(self._at_ns, end_ns) if after is not None else len(self._at_ns)
        # Of possibly thousands of readings only those around the requested times are needed.
        first = max(bisect_right(self._at_ns, int(t_ns.min()), low, max(low, high)) - 1, low)
        last = bisect_left(self._at_ns, int(t_ns.max()), first, max(first, high)) + 1
        chosen = slice(first, min(last, high))
        knots = list(zip(self._at_ns[chosen], self._positions[chosen], strict=True))
        if before is not None and first == low:
            knots.insert(0, (begin_ns, float(before.state(begin_ns)[0])))
        if after is not None and last >= high:
            knots.append((end_ns, float(after.state(end_ns)[0])))
        at_s = np.array([at_ns - knots[0][0] for at_ns, _ in knots]) * 1e-9
        positions = np.array([position for _, position in knots])
        t_s = (np.clip(t_ns, -TIME_LIMIT, TIME_LIMIT) - knots[0][0]) * 1e-9
        position = np.interp(t_s, at_s, positions)
        if len(knots) < 2:
            return position, np.zeros_like(position)
        slopes = np.diff(positions) / np.maximum(np.diff(at_s), 1e-9)
        piece = np.clip(np.searchsorted(at_s, t_s) - 1, 0, len(slopes) - 1)
        inside = (t_s >= at_s[0]) & (t_s <= at_s[-1])
        return position, np.where(inside, slopes[piece], 0.0)

    def _begin(self, leg: Leg) -> None:
        last = self._legs[-1]
        if isinstance(last, Move) and last.plan() is not None:
            self._delays = last.delays
        self._legs.append(leg)
        del self._legs[:-_LEGS_MAX]
