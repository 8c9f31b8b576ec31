"""One motion of a stage, as ordered, and the encoder readings that determine its start."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.numbers import TIME_LIMIT
from eschorty_ros.core.clocks.motion import MotionPlan, plan_stop
from eschorty_ros.core.clocks.motion_start import Delays, Timing, fitted_shape, start_of

_LEG_READINGS_MAX = 512
_REST_MM = 1e-4
# A move is kept while _KEPT_SHARE of its readings agree with it. Its speed and acceleration are
# fitted from _READINGS_MIN readings on when fewer than _AGREEING_SHARE agree; after that each time
# there are _REFIT_GROWTH times as many.
_READINGS_MIN = 6
_AGREEING_SHARE = 0.8
_KEPT_SHARE = 0.6
_REFIT_GROWTH = 1.2
_START_LATEST_S = 0.5


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
        """Return the trapezoid from its estimated start; ``None`` if readings contradict it."""
        if not self._fits:
            return None
        start_s = self._not_before_s if self._timing is None else self._timing.start_s
        return replace(self._shape, start_ns=self.from_ns + round(start_s * 1e9))

    def add(self, reading: Reading) -> None:
        """Estimate the start, and where readings contradict it speed and acceleration, again."""
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
        """Return the earliest start, as long as the start is not within ``spread_ns``."""
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
        """Return the lowest and highest position between two times; ``None`` if unknown."""
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
        """Return the ramp."""
        return self._plan

    def add(self, reading: Reading) -> None:
        """Let the ramp begin where it ends at the place of a carriage at rest."""
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
        """Return the places between which the carriage comes to rest."""
        places = float(self._plan.position_mm), self._before.end_mm
        return min(places), max(places)
