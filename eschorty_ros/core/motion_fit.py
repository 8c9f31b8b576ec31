"""A stage's motion from encoder readings that arrive late: position as a function of time.

A reading is exact in place and vague in time: it was taken after it was asked for and before it
arrived. The motion is known but for when it began: pieces of constant acceleration. Each reading
bounds the beginning from both sides, and many readings settle it far better than their delays
spread. Where the motion is not known, or does not fit, positions lie on lines between readings.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core._checks import TIME_LIMIT, number, positive, times, whole
from eschorty_ros.core.clock import POSITION_LIMIT_MM
from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.motion import MotionPlan, plan_move, plan_stop

Array = NDArray[np.float64]

_LEGS_MAX = 64
_READINGS_MAX = 10_000
_LEG_READINGS_MAX = 512
_SETTLED_MM = 1e-4
_LEAST_TO_JUDGE = 6
_AGREEING_SHARE = 0.8
_LEAST_SHARE = 0.6
# A shape that readings have changed is looked at again with so many times the readings.
_AGAIN = 1.2
# A motion that does not begin by then after it was ordered is not the one expected.
LATEST_START_S = 0.5
# A share of the fastest samples' speed below which a sample says little about time.
_FAST = 0.5
_LEAST_SAMPLES = 8
_ITERATIONS = 12
_SPEED_PRIOR = 0.02
_ACCELERATION_PRIOR = 0.3


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


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of the encoder, taken between the two times."""

    position_mm: float
    earliest_ns: int | None
    latest_ns: int

    @property
    def middle_ns(self) -> int:
        """Time in the middle of what is possible; the latest when no earliest is known."""
        if self.earliest_ns is None:
            return self.latest_ns
        return (self.earliest_ns + self.latest_ns) // 2


class Unknown:
    """A leg nobody knows; positions lie between readings."""

    residual_mm = math.nan
    sigma_mm = math.nan
    strays = 0

    def __init__(self, from_ns: int) -> None:
        self.from_ns = from_ns

    def plan(self) -> MotionPlan | None:
        """No plan."""
        return None

    def add(self, reading: Reading) -> None:
        """Learn nothing."""

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        """Expect nothing."""
        return None


class Move:
    """A trapezoid that begins some time after ``planned.start_ns``.

    Parameters
    ----------
    planned : MotionPlan
        Starts at rest, as early as it can.
    tolerance_mm : float
        How far a reading may lie beside the motion.
    usual : Delays
        Of the readings of earlier motions.
    """

    def __init__(self, planned: MotionPlan, tolerance_mm: float, usual: Delays) -> None:
        self.from_ns = planned.start_ns
        self.residual_mm = 0.0
        self.sigma_mm = math.nan
        self.strays = 0
        self._shape = planned
        self._tolerance_mm = tolerance_mm
        self._readings: list[Reading] = []
        self._passing_s: list[float] = []
        self._speed: list[float] = []
        self._usual = usual
        self._not_before_s = 0.0
        self._not_after_s = math.inf
        self._timing: Timing | None = None
        self._reshaped_at = 0
        self._fits = True

    def plan(self) -> MotionPlan | None:
        """Tell the motion at its estimated time; ``None`` when readings contradict it."""
        if not self._fits:
            return None
        start_s = self._not_before_s if self._timing is None else self._timing.start_s
        return replace(self._shape, start_ns=self.from_ns + round(start_s * 1e9))

    def add(self, reading: Reading) -> None:
        """Learn from one reading."""
        shape, tolerance_mm = self._shape, self._tolerance_mm
        travelled = abs(reading.position_mm - shape.position_mm)
        left = abs(shape.end_mm - reading.position_mm)
        if travelled <= tolerance_mm:
            if reading.earliest_ns is not None and self._timing is None:
                ramp = max((abs(a) for a in shape.accelerations_mm_s2), default=1.0)
                unseen_s = math.sqrt(4.0 * tolerance_mm / ramp)
                asked_s = (reading.earliest_ns - self.from_ns) * 1e-9 - unseen_s
                self._not_before_s = max(self._not_before_s, asked_s)
            return
        if left <= tolerance_mm:
            whole_s = (shape.end_ns - shape.start_ns) * 1e-9
            self._not_after_s = min(
                self._not_after_s, (reading.latest_ns - self.from_ns) * 1e-9 - whole_s
            )
            return
        if len(self._readings) == _LEG_READINGS_MAX:
            for values in (self._readings, self._passing_s, self._speed):
                del values[0]
        self._readings.append(reading)
        self._time([reading])
        self._fit()

    @property
    def delays(self) -> Delays:
        """Delays of the readings so far."""
        return self._usual if self._timing is None else self._timing.delays

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        """Lowest and highest position a reading between the two times can have."""
        if not self._fits:
            return None
        if self._timing is None:
            starts = self._not_before_s, self._not_before_s + LATEST_START_S
        else:
            margin_s = 1e-3 + 5.0 * self._timing.sigma_s
            early_s, late_s = self._timing.start_s - margin_s, self._timing.start_s + margin_s
            # Arrivals alone say how late it began at most.
            starts = early_s if self._timing.bounded_below else self._not_before_s, late_s
        early_ns, late_ns = (self.from_ns + round(start_s * 1e9) for start_s in starts)
        first = float(replace(self._shape, start_ns=late_ns).state(earliest_ns)[0])
        last = float(replace(self._shape, start_ns=early_ns).state(latest_ns)[0])
        return min(first, last), max(first, last)

    def _time(self, readings: list[Reading]) -> None:
        """Append when and how fast the shape passes the readings."""
        positions = np.array([reading.position_mm for reading in readings])
        passing_s = self._shape.passing_s(positions)
        at_ns = self._shape.start_ns + np.nan_to_num(np.rint(passing_s * 1e9)).astype(np.int64)
        self._passing_s += passing_s.tolist()
        self._speed += np.abs(self._shape.state(at_ns)[1]).tolist()

    def _bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Earliest and latest time of each reading (s after ``from_ns``)."""
        earliest = [
            -math.inf
            if reading.earliest_ns is None
            else (reading.earliest_ns - self.from_ns) * 1e-9
            for reading in self._readings
        ]
        latest = [(reading.latest_ns - self.from_ns) * 1e-9 for reading in self._readings]
        return np.array(earliest), np.array(latest)

    def _fit(self) -> None:
        earliest_s, latest_s = self._bounds()
        agreeing = self._estimate(earliest_s, latest_s)
        count = len(self._readings)
        if count < _LEAST_TO_JUDGE or count < _AGAIN * self._reshaped_at:
            return
        if agreeing >= _AGREEING_SHARE and not self._reshaped_at:
            return
        self._reshaped_at = count
        positions = np.array([reading.position_mm for reading in self._readings])
        shape = refined_shape(self._shape, positions, earliest_s, latest_s)
        if shape is not None:
            before = self._shape, self._passing_s, self._speed
            self._shape, self._passing_s, self._speed = shape, [], []
            self._time(self._readings)
            better = self._estimate(earliest_s, latest_s)
            if better < agreeing:
                self._shape, self._passing_s, self._speed = before
                self._estimate(earliest_s, latest_s)
            agreeing = max(agreeing, better)
        self._fits = agreeing >= _LEAST_SHARE

    def _estimate(self, earliest_s: NDArray[np.float64], latest_s: NDArray[np.float64]) -> float:
        """Estimate the start; the share of readings that agree with it."""
        passing_s, speed = np.array(self._passing_s), np.array(self._speed)
        there = ~np.isnan(passing_s)
        if not there.any():
            return 0.0
        slack_s = self._tolerance_mm / np.maximum(speed[there], 1e-3)
        timing = start_of(
            earliest_s[there] - passing_s[there],
            latest_s[there] - passing_s[there],
            slack_s,
            speed[there],
            self._usual,
        )
        start_s = max(min(timing.start_s, self._not_after_s), self._not_before_s)
        self._timing = replace(timing, start_s=start_s)
        self.sigma_mm = timing.sigma_s * float(speed[there].max())
        agreeing = int(np.count_nonzero(timing.agreeing))
        self.strays = len(passing_s) - agreeing
        self.residual_mm = self._residual_mm()
        return agreeing / len(passing_s)

    def _residual_mm(self) -> float:
        """Root mean square of how far readings lie outside what their times allow."""
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
        beside = positions - np.clip(positions, bounds.min(axis=0), bounds.max(axis=0))
        return float(np.sqrt(np.mean(beside**2)))


class Stop:
    """The profiled end of a move, begun some time after it was ordered.

    Where the carriage comes to rest tells when the ramp began.
    """

    sigma_mm = math.nan
    strays = 0

    def __init__(
        self, before: MotionPlan, at_ns: int, deceleration_mm_s2: float, tolerance_mm: float
    ) -> None:
        self.residual_mm = 0.0
        self._before = before
        self._deceleration_mm_s2 = deceleration_mm_s2
        self._tolerance_mm = tolerance_mm
        self._plan = plan_stop(before, at_ns, deceleration_mm_s2)
        self._ordered_ns = at_ns
        self._last: Reading | None = None

    @property
    def from_ns(self) -> int:
        """Begin of the ramp."""
        return self._plan.start_ns

    def plan(self) -> MotionPlan | None:
        """Tell the ramp at its estimated time."""
        return self._plan

    def add(self, reading: Reading) -> None:
        """Learn from the place of rest."""
        last, self._last = self._last, reading
        if last is None or abs(last.position_mm - reading.position_mm) > self._tolerance_mm:
            return
        if abs(self._plan.end_mm - reading.position_mm) < _SETTLED_MM:
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
        self.residual_mm = abs(self._plan.end_mm - reading.position_mm)

    def expected_mm(self, earliest_ns: int, latest_ns: int) -> tuple[float, float] | None:
        """Expect any place between here and the end of the interrupted motion."""
        places = float(self._plan.position_mm), self._before.end_mm
        return min(places), max(places)


Leg = Unknown | Move | Stop


@dataclass(frozen=True, slots=True)
class Delays:
    """Mean time (s) from request to sample and from sample to receipt, the line's own left out.

    A request is written to an idle line; an answer waits for adapter, kernel and scheduler.
    """

    before_s: float = 1e-4
    after_s: float = 1e-3


@dataclass(frozen=True, slots=True)
class Timing:
    """Start of a motion (s), its standard deviation (s), and which samples agree with it."""

    start_s: float
    sigma_s: float
    agreeing: NDArray[np.bool_]
    delays: Delays
    bounded_below: bool = False


def widest_agreement(low: Array, high: Array) -> tuple[float, float]:
    """Times that most of the intervals share (Marzullo 1984): a few wrong ones do no harm."""
    ends = np.concatenate((low, high))
    steps = np.concatenate((np.ones(low.size), -np.ones(high.size)))
    order = np.lexsort((-steps, ends))
    depth = np.cumsum(steps[order])
    best = int(np.argmax(depth))
    return float(ends[order][best]), float(ends[order][min(best + 1, ends.size - 1)])


def start_of(
    earliest_s: Array, latest_s: Array, slack_s: Array, speed: Array, usual: Delays
) -> Timing:
    """Start from each sample's earliest and latest, as the sample alone would have it.

    Delays are positive: the true start is after all ``earliest`` and before all ``latest``. The
    extremes miss it by the mean delay over the number of samples, as for exponential delays; both
    sides are joined by the inverse squares of that. The usual delay counts as one sample more.

    Parameters
    ----------
    earliest_s, latest_s : float64, shape (n,)
        ``-inf`` for an unknown earliest.
    slack_s : float64, shape (n,)
        Uncertainty of time that the position's own brings.
    speed : float64, shape (n,)
    usual : Delays
        Of earlier motions.
    """
    begin, end = widest_agreement(earliest_s - slack_s, latest_s + slack_s)
    middle = 0.5 * (begin + end) if np.isfinite(begin) else end
    agreeing = (earliest_s - slack_s <= middle) & (latest_s + slack_s >= middle)
    use = agreeing & (speed >= _FAST * speed[agreeing].max(initial=0.0))
    if not use.any():
        return Timing(middle, float(end - begin), agreeing, usual)
    floor_s = float(slack_s[use].min()) + 1e-9
    after, late_s, after_s = _extreme(latest_s[use], usual.after_s, floor_s)
    known = use & np.isfinite(earliest_s)
    if not known.any():
        return Timing(after, late_s, agreeing, Delays(usual.before_s, after_s))
    before, early_s, before_s = _extreme(-earliest_s[known], usual.before_s, floor_s)
    weights = np.array([late_s**-2, early_s**-2])
    joined = float(weights @ np.array([after, -before]) / weights.sum())
    low, high = sorted((float(latest_s[use].min()), float(earliest_s[known].max())))
    sigma_s = float(weights.sum() ** -0.5)
    start_s = min(max(joined, low), high)
    return Timing(start_s, sigma_s, agreeing, Delays(before_s, after_s), bounded_below=True)


def _extreme(values: Array, usual_s: float, floor_s: float) -> tuple[float, float, float]:
    """Lower end of positive delays, the error of it, and the mean delay."""
    least, count = float(values.min()), values.size
    mean_s = float(values.mean()) - least + usual_s / count
    correction = mean_s / count
    return least - correction, max(correction, floor_s), mean_s


def refined_shape(
    plan: MotionPlan, positions: Array, earliest_s: Array, latest_s: Array
) -> MotionPlan | None:
    """Trapezoid ``plan`` with the speed and acceleration that suit the readings' times best.

    Least squares on the middle of each reading's interval, with the plan's own values as a prior
    of 2 % in speed and 30 % in acceleration. ``None`` where the readings do not tell.
    """
    if positions.size < _LEAST_SAMPLES or len(plan.durations_s) != 3:
        return None
    acceleration = abs(plan.accelerations_mm_s2[0])
    speed = acceleration * plan.durations_s[0]
    known = np.isfinite(earliest_s)
    middle = np.where(known, 0.5 * (np.where(known, earliest_s, 0.0) + latest_s), latest_s)
    spread = np.where(known, latest_s - np.where(known, earliest_s, 0.0), 0.0)
    weight = 1.0 / (np.where(known, spread, np.max(spread, initial=1e-3)) + 1e-4)

    def shaped(parameters: Array) -> MotionPlan:
        return plan_move(
            plan.start_ns,
            plan.position_mm,
            plan.end_mm,
            speed * float(np.exp(parameters[1])),
            acceleration * float(np.exp(parameters[2])),
        )

    def residual(parameters: Array) -> Array:
        passing_s = shaped(parameters).passing_s(positions)
        own = np.nan_to_num(middle - parameters[0] - passing_s) * weight
        prior = parameters[1:] / np.array([_SPEED_PRIOR, _ACCELERATION_PRIOR])
        return np.concatenate((own, prior))

    # Least squares with the start free; logarithms keep speed and acceleration positive.
    parameters = np.array([float(np.median(middle - plan.passing_s(positions))), 0.0, 0.0])
    if not np.isfinite(parameters[0]):
        return None
    for _ in range(_ITERATIONS):
        now = residual(parameters)
        step = 1e-5
        jacobian = np.stack(
            [(residual(parameters + step * unit) - now) / step for unit in np.eye(3)], axis=1
        )
        change, *_ = np.linalg.lstsq(jacobian, -now, rcond=None)
        parameters = parameters + np.clip(change, -0.2, 0.2)
        if np.abs(change).max() < 1e-9:
            break
    return shaped(parameters)
