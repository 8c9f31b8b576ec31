"""Legs of a motion as it was ordered: a move, a stop, or something nobody knows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core._motion_timing import Delays, Timing, refined_shape, start_of
from eschorty_ros.core.motion import MotionPlan, plan_stop

_READINGS_MAX = 512
_SETTLED_MM = 1e-4
_LEAST_TO_JUDGE = 6
_AGREEING_SHARE = 0.8
_LEAST_SHARE = 0.6
# A shape that readings have changed is looked at again with so many times the readings.
_AGAIN = 1.2
# A motion that does not begin by then after it was ordered is not the one expected.
LATEST_START_S = 0.5


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
        if len(self._readings) == _READINGS_MAX:
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
