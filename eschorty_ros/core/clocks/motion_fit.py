"""Position of a stage over time, from encoder readings that arrive late.

The position of a reading is exact and its time uncertain: it was taken after its request and before
its receipt. The ordered motion, pieces of constant acceleration, is known except for its start.
Each reading bounds the start from both sides, so that many readings determine it to far less than
the spread of their delays. Where the motion is unknown, or contradicts the readings, positions are
interpolated linearly between readings.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, replace
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import TIME_LIMIT, Array, integer, number, positive, times
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks.motion import MotionPlan, plan_move, plan_stop
from eschorty_ros.core.clocks.stage_track import POSITION_LIMIT_MM

_LEGS_MAX = 64
_READINGS_MAX = 10_000
_LEG_READINGS_MAX = 512
# Readings whose usual spread between request and receipt is that of a host that keeps up.
_USUAL_READINGS = 32
# A motion whose start is bounded less well than by two usual readings is not yet known.
_USUAL_SPREADS = 2
_REST_MM = 1e-4
# A move is kept while _KEPT_SHARE of its readings agree with it. Its speed and acceleration are
# fitted from _READINGS_MIN readings on when fewer than _AGREEING_SHARE agree; after that each time
# there are _REFIT_GROWTH times as many.
_READINGS_MIN = 6
_AGREEING_SHARE = 0.8
_KEPT_SHARE = 0.6
_REFIT_GROWTH = 1.2
_START_LATEST_S = 0.5
# Readings at less than this share of the fastest one's speed do not determine the start.
_FAST_SHARE = 0.5
_SHAPE_READINGS_MIN = 8
_SPEED_SIGMA = 0.02
_ACCELERATION_SIGMA = 0.3


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


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of the encoder, taken between the two times."""

    position_mm: float
    earliest_ns: int | None
    latest_ns: int

    @property
    def middle_ns(self) -> int:
        """Middle of both times; the latest where the earliest is unknown."""
        if self.earliest_ns is None:
            return self.latest_ns
        return (self.earliest_ns + self.latest_ns) // 2


class Leg:
    """A span of time with an unknown motion, from ``from_ns`` on."""

    residual_mm = math.nan
    sigma_mm = math.nan
    outliers = 0

    def __init__(self, from_ns: int) -> None:
        self.from_ns = from_ns

    def plan(self) -> MotionPlan | None:
        """Return the motion from its estimated start; ``None`` if readings contradict it."""
        return None

    def add(self, reading: Reading) -> None:
        """Use one reading."""

    def known_until_ns(self, spread_ns: float) -> int:
        """Return the time up to which it is known when its start has to be within ``spread_ns``."""
        return TIME_LIMIT

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        """Return the lowest and highest position between two times; ``None`` if unknown."""
        return None


class Move(Leg):
    """A trapezoid that begins some time after ``planned.start_ns``.

    - ``planned``: Starts at rest, at the earliest possible time.
    - ``tolerance_mm``: Largest deviation of a reading from the motion.
    - ``usual``: Of the readings of earlier motions.
    """

    def __init__(self, planned: MotionPlan, tolerance_mm: float, usual: Delays) -> None:
        super().__init__(planned.start_ns)
        self.residual_mm = 0.0
        self._shape = planned
        self._tolerance_mm = tolerance_mm
        self._readings: list[Reading] = []
        self._passing_s: list[float] = []
        self._speed: list[float] = []
        self._usual = usual
        self._not_before_s = 0.0
        self._not_after_s = math.inf
        self._timing: Timing | None = None
        self._readings_at_refit = 0
        self._fits = True

    def plan(self) -> MotionPlan | None:
        if not self._fits:
            return None
        start_s = self._not_before_s if self._timing is None else self._timing.start_s
        return replace(self._shape, start_ns=self.from_ns + round(start_s * 1e9))

    def add(self, reading: Reading) -> None:
        shape, tolerance_mm = self._shape, self._tolerance_mm
        if abs(reading.position_mm - shape.position_mm) <= tolerance_mm:
            if reading.earliest_ns is not None and self._timing is None:
                ramp = max((abs(a) for a in shape.accelerations_mm_s2), default=1.0)
                within_s = math.sqrt(4.0 * tolerance_mm / ramp)
                request_s = (reading.earliest_ns - self.from_ns) * 1e-9
                self._not_before_s = max(self._not_before_s, request_s - within_s)
            return
        if abs(shape.end_mm - reading.position_mm) <= tolerance_mm:
            duration_s = (shape.end_ns - shape.start_ns) * 1e-9
            latest_s = (reading.latest_ns - self.from_ns) * 1e-9
            self._not_after_s = min(self._not_after_s, latest_s - duration_s)
            return
        if len(self._readings) == _LEG_READINGS_MAX:
            for values in (self._readings, self._passing_s, self._speed):
                del values[0]
        self._readings.append(reading)
        self._append_passings([reading])
        self._fit()

    def known_until_ns(self, spread_ns: float) -> int:
        if not self._fits or math.isfinite(self._not_after_s):
            return TIME_LIMIT
        begin_s = self._not_before_s
        if self._timing is not None:
            begin_s = max(begin_s, self._timing.begin_s)
            # A slow carriage takes long for what a reading may deviate by.
            slack_s = 2.0 * self._tolerance_mm / max(*self._speed, 1e-3)
            if (self._timing.end_s - begin_s - slack_s) * 1e9 <= spread_ns:
                return TIME_LIMIT
        return self.from_ns + round(begin_s * 1e9)

    @property
    def delays(self) -> Delays:
        """Delays of the readings so far."""
        return self._usual if self._timing is None else self._timing.delays

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        if not self._fits:
            return None
        if self._timing is None:
            starts = self._not_before_s, self._not_before_s + _START_LATEST_S
        else:
            margin_s = 1e-3 + 5.0 * self._timing.sigma_s
            early_s, late_s = self._timing.start_s - margin_s, self._timing.start_s + margin_s
            # Receipts alone bound the start from above only.
            starts = early_s if self._timing.bounded_below else self._not_before_s, late_s
        early_ns, late_ns = (self.from_ns + round(start_s * 1e9) for start_s in starts)
        first = float(replace(self._shape, start_ns=late_ns).state(earliest_ns)[0])
        last = float(replace(self._shape, start_ns=early_ns).state(latest_ns)[0])
        return min(first, last), max(first, last)

    def _append_passings(self, readings: list[Reading]) -> None:
        """Append the time and speed at which the shape passes each reading."""
        positions = np.array([reading.position_mm for reading in readings])
        passing_s = self._shape.passing_s(positions)
        at_ns = self._shape.start_ns + np.nan_to_num(np.rint(passing_s * 1e9)).astype(np.int64)
        self._passing_s += passing_s.tolist()
        self._speed += np.abs(self._shape.state(at_ns)[1]).tolist()

    def _bounds_s(self) -> tuple[Array, Array]:
        """Return the earliest (-inf if unknown) and latest time of each reading after from_ns."""
        earliest = [
            -math.inf
            if reading.earliest_ns is None
            else (reading.earliest_ns - self.from_ns) * 1e-9
            for reading in self._readings
        ]
        latest = [(reading.latest_ns - self.from_ns) * 1e-9 for reading in self._readings]
        return np.array(earliest), np.array(latest)

    def _fit(self) -> None:
        earliest_s, latest_s = self._bounds_s()
        agreeing = self._estimate_start(earliest_s, latest_s)
        count = len(self._readings)
        if count < _READINGS_MIN or count < _REFIT_GROWTH * self._readings_at_refit:
            return
        if agreeing >= _AGREEING_SHARE and not self._readings_at_refit:
            return
        self._readings_at_refit = count
        positions = np.array([reading.position_mm for reading in self._readings])
        shape = fitted_shape(self._shape, positions, earliest_s, latest_s)
        if shape is not None:
            before = self._shape, self._passing_s, self._speed
            self._shape, self._passing_s, self._speed = shape, [], []
            self._append_passings(self._readings)
            better = self._estimate_start(earliest_s, latest_s)
            if better < agreeing:
                self._shape, self._passing_s, self._speed = before
                self._estimate_start(earliest_s, latest_s)
            agreeing = max(agreeing, better)
        self._fits = agreeing >= _KEPT_SHARE

    def _estimate_start(self, earliest_s: Array, latest_s: Array) -> float:
        """Estimate the start and return the share of readings that agree with it."""
        passing_s, speed = np.array(self._passing_s), np.array(self._speed)
        passed = ~np.isnan(passing_s)
        if not passed.any():
            return 0.0
        timing = start_of(
            earliest_s[passed] - passing_s[passed],
            latest_s[passed] - passing_s[passed],
            self._tolerance_mm / np.maximum(speed[passed], 1e-3),
            speed[passed],
            self._usual,
        )
        # The slow readings, which are not averaged, bound it all the same.
        start_s = min(max(timing.start_s, timing.begin_s), timing.end_s)
        start_s = max(min(start_s, self._not_after_s), self._not_before_s)
        self._timing = replace(timing, start_s=start_s)
        self.sigma_mm = timing.sigma_s * float(speed[passed].max())
        agreeing = int(np.count_nonzero(timing.agreeing))
        self.outliers = len(passing_s) - agreeing
        self.residual_mm = self._rms_outside_mm()
        return agreeing / len(passing_s)

    def _rms_outside_mm(self) -> float:
        """Return the root mean square distance of readings from the motion within their times."""
        plan = self.plan()
        if plan is None:
            return math.nan
        latest_ns = np.array([reading.latest_ns for reading in self._readings])
        earliest_ns = np.array(
            [
                self.from_ns if reading.earliest_ns is None else reading.earliest_ns
                for reading in self._readings
            ]
        )
        bounds = np.stack((plan.state(earliest_ns)[0], plan.state(latest_ns)[0]))
        positions = np.array([reading.position_mm for reading in self._readings])
        outside = positions - np.clip(positions, bounds.min(axis=0), bounds.max(axis=0))
        return float(np.sqrt(np.mean(outside**2)))


class Stop(Leg):
    """The profiled end of a move, which begins some time after it was ordered.

    The position where the carriage comes to rest determines the time at which the ramp began.
    """

    def __init__(
        self, before: MotionPlan, at_ns: int, deceleration_mm_s2: float, tolerance_mm: float
    ) -> None:
        self._plan = plan_stop(before, at_ns, deceleration_mm_s2)
        super().__init__(self._plan.start_ns)
        self.residual_mm = 0.0
        self._before = before
        self._deceleration_mm_s2 = deceleration_mm_s2
        self._tolerance_mm = tolerance_mm
        self._ordered_ns = at_ns
        self._last: Reading | None = None

    def plan(self) -> MotionPlan | None:
        return self._plan

    def add(self, reading: Reading) -> None:
        last, self._last = self._last, reading
        if last is None or abs(last.position_mm - reading.position_mm) > self._tolerance_mm:
            return
        if abs(self._plan.end_mm - reading.position_mm) < _REST_MM:
            return
        low_ns = self._ordered_ns
        high_ns = max(reading.latest_ns, low_ns)
        forward = self._before.end_mm >= self._before.position_mm
        while high_ns - low_ns > 100:
            middle_ns = (low_ns + high_ns) // 2
            end_mm = plan_stop(self._before, middle_ns, self._deceleration_mm_s2).end_mm
            if (end_mm < reading.position_mm) == forward:
                low_ns = middle_ns
            else:
                high_ns = middle_ns
        self._plan = plan_stop(self._before, low_ns, self._deceleration_mm_s2)
        self.from_ns = self._plan.start_ns
        self.residual_mm = abs(self._plan.end_mm - reading.position_mm)

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        places = float(self._plan.position_mm), self._before.end_mm
        return min(places), max(places)


@dataclass(frozen=True, slots=True)
class Delays:
    """Mean time (s) from request to sample and from sample to receipt, without the transfer.

    A request is written to an idle line; an answer is delayed by adapter, kernel and scheduler.
    """

    before_s: float = 1e-4
    after_s: float = 1e-3


@dataclass(frozen=True, slots=True)
class Timing:
    """Start of a motion (s), its standard deviation (s), and which readings agree with it.

    It is between ``begin_s`` and ``end_s``; ``begin_s`` is -inf where no request is known.
    """

    start_s: float
    sigma_s: float
    begin_s: float
    end_s: float
    agreeing: NDArray[np.bool_]
    delays: Delays
    bounded_below: bool = False


def start_of(
    earliest_s: Array, latest_s: Array, slack_s: Array, speed: Array, usual: Delays
) -> Timing:
    """Estimate the start from the bounds of each reading.

    Delays are positive: the true start is after all ``earliest`` and before all ``latest``. The
    extremes are off by the mean delay over the number of readings, as for exponential delays; the
    two are averaged with the inverse squares of that as weights. The usual delay counts as one
    more reading.

    - ``earliest_s``, ``latest_s``: Shape (n,). ``-inf`` for an unknown earliest.
    - ``slack_s``: Shape (n,). Uncertainty of time due to that of the position.
    - ``speed``: Shape (n,).
    - ``usual``: Of earlier motions.
    """
    begin, end = _widest_agreement(earliest_s - slack_s, latest_s + slack_s)
    middle = 0.5 * (begin + end) if np.isfinite(begin) else end
    agreeing = (earliest_s - slack_s <= middle) & (latest_s + slack_s >= middle)
    use = agreeing & (speed >= _FAST_SHARE * speed[agreeing].max(initial=0.0))
    if not use.any():
        return Timing(middle, float(end - begin), begin, end, agreeing, usual)
    floor_s = float(slack_s[use].min()) + 1e-9
    after = _lower_end(latest_s[use], usual.after_s, floor_s)
    known = use & np.isfinite(earliest_s)
    if not known.any():
        delays = Delays(usual.before_s, after.delay_s)
        return Timing(after.end_s, after.error_s, begin, end, agreeing, delays)
    before = _lower_end(-earliest_s[known], usual.before_s, floor_s)
    weights = np.array([after.error_s**-2, before.error_s**-2])
    joined = float(weights @ np.array([after.end_s, -before.end_s]) / weights.sum())
    low, high = sorted((float(latest_s[use].min()), float(earliest_s[known].max())))
    sigma_s = float(weights.sum() ** -0.5)
    start_s = min(max(joined, low), high)
    delays = Delays(before.delay_s, after.delay_s)
    return Timing(start_s, sigma_s, begin, end, agreeing, delays, bounded_below=True)


def _widest_agreement(low: Array, high: Array) -> tuple[float, float]:
    """Return the interval that most of the intervals share (Marzullo 1984)."""
    ends = np.concatenate((low, high))
    steps = np.concatenate((np.ones(low.size), -np.ones(high.size)))
    order = np.lexsort((-steps, ends))
    depth = np.cumsum(steps[order])
    best = int(np.argmax(depth))
    return float(ends[order][best]), float(ends[order][min(best + 1, ends.size - 1)])


class _LowerEnd(NamedTuple):
    """Lower end of positive delays, its error, and the mean delay."""

    end_s: float
    error_s: float
    delay_s: float


def _lower_end(values: Array, usual_s: float, floor_s: float) -> _LowerEnd:
    """Return the lower end of times with positive delays."""
    least, count = float(values.min()), values.size
    mean_s = float(values.mean()) - least + usual_s / count
    correction = mean_s / count
    return _LowerEnd(least - correction, max(correction, floor_s), mean_s)


def fitted_shape(
    plan: MotionPlan, positions: Array, earliest_s: Array, latest_s: Array
) -> MotionPlan | None:
    """Return trapezoid ``plan`` with the speed and acceleration that fit the readings' times best.

    Least squares on the middle of each reading's interval, with the plan's own values as a prior
    of 2 % in speed and 30 % in acceleration. ``None`` where the readings are too few.
    """
    # A reading beyond the target, such as one of an overshoot, is passed at no time.
    passing_s = plan.passing_s(positions)
    reached = np.isfinite(passing_s)
    positions, earliest_s, latest_s = positions[reached], earliest_s[reached], latest_s[reached]
    if positions.size < _SHAPE_READINGS_MIN or len(plan.durations_s) != 3:
        return None
    acceleration = abs(plan.accelerations_mm_s2[0])
    speed = acceleration * plan.durations_s[0]
    known = np.isfinite(earliest_s)
    middle = np.where(known, 0.5 * (np.where(known, earliest_s, 0.0) + latest_s), latest_s)
    spread = np.where(known, latest_s - np.where(known, earliest_s, 0.0), 0.0)
    weight = 1.0 / (np.where(known, spread, np.max(spread, initial=1e-3)) + 1e-4)

    def shaped(log_speed: float, log_acceleration: float) -> MotionPlan:
        return plan_move(
            plan.start_ns,
            plan.position_mm,
            plan.end_mm,
            speed * math.exp(log_speed),
            acceleration * math.exp(log_acceleration),
        )

    # The import takes longer than a reading of the stage.
    from scipy.optimize import least_squares

    def residuals(parameters: Array) -> Array:
        start_s, log_speed, log_acceleration = parameters
        passing_s = shaped(log_speed, log_acceleration).passing_s(positions)
        late = np.nan_to_num(middle - start_s - passing_s) * weight
        prior = (log_speed / _SPEED_SIGMA, log_acceleration / _ACCELERATION_SIGMA)
        return np.concatenate((late, prior))

    start_s = float(np.median(middle - passing_s[reached]))
    fit = least_squares(residuals, (start_s, 0.0, 0.0), diff_step=1e-5, x_scale="jac")
    return shaped(fit.x[1], fit.x[2])
