"""Planned straight-line motion as pieces of constant acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import times, vector
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer, number, positive
from eschorty_ros.core.clocks.stage_track import POSITION_LIMIT_MM


@dataclass(frozen=True, slots=True)
class MotionPlan:
    """Position as a function of time from ``start_ns`` on; at rest after the last piece."""

    start_ns: int
    """Time the plan begins, ns of any clock."""
    position_mm: float
    velocity_mm_s: float = 0.0
    """State at ``start_ns``."""
    durations_s: tuple[float, ...] = ()
    accelerations_mm_s2: tuple[float, ...] = ()
    """One entry per piece."""

    def __post_init__(self) -> None:
        integer("start_ns", self.start_ns, -TIME_LIMIT, TIME_LIMIT)
        for name in ("position_mm", "velocity_mm_s"):
            number(name, getattr(self, name))
        for name in ("durations_s", "accelerations_mm_s2"):
            vector(name, getattr(self, name))
        if len(self.durations_s) != len(self.accelerations_mm_s2):
            raise ArgumentError(
                f"durations_s has {len(self.durations_s)} pieces and accelerations_mm_s2 "
                f"{len(self.accelerations_mm_s2)}; give one acceleration per duration"
            )
        if not all(duration >= 0.0 for duration in self.durations_s):
            raise ArgumentError(f"durations_s is {self.durations_s!r}; give lengths of 0 or more")
        if not math.fsum(self.durations_s) * 1e9 <= TIME_LIMIT:
            raise ArgumentError(f"durations_s is {self.durations_s!r}; give less than a century")

    @property
    def end_ns(self) -> int:
        """Time of the last piece's end."""
        return self.start_ns + round(math.fsum(self.durations_s) * 1e9)

    @property
    def end_mm(self) -> float:
        """Position after the last piece."""
        return float(self.state(self.end_ns)[0])

    def state(self, t_ns: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return position (mm) and velocity (mm/s) at integer times ``t_ns``, in its shape.

        Before ``start_ns`` the state at ``start_ns``; from ``end_ns`` on exactly one position and
        velocity 0.
        """
        now_ns = times("t_ns", t_ns)
        ended = now_ns >= self.end_ns
        since_ns = np.maximum(now_ns, self.start_ns) - self.start_ns
        elapsed_s = np.where(ended, np.inf, since_ns * 1e-9)
        position = np.full(elapsed_s.shape, self.position_mm, dtype=np.float64)
        velocity = np.full(elapsed_s.shape, self.velocity_mm_s, dtype=np.float64)
        began_s = 0.0
        for duration_s, acceleration in zip(
            self.durations_s, self.accelerations_mm_s2, strict=True
        ):
            dt = np.clip(elapsed_s - began_s, 0.0, duration_s)
            position += velocity * dt + 0.5 * acceleration * dt * dt
            velocity += acceleration * dt
            began_s += duration_s
        velocity[ended] = 0.0
        return position, velocity

    def passing_s(self, position_mm: ArrayLike) -> NDArray[np.float64]:
        """Return the time after ``start_ns`` (s) at which each position is first reached.

        NaN where it is never reached.
        """
        place = vector("position_mm", position_mm)
        passing = np.where(place == self.position_mm, 0.0, np.nan)
        position, velocity, began_s = self.position_mm, self.velocity_mm_s, 0.0
        for duration_s, acceleration in zip(
            self.durations_s, self.accelerations_mm_s2, strict=True
        ):
            with np.errstate(all="ignore"):
                elapsed_s = _first_root(place - position, velocity, acceleration, duration_s)
            passing = np.where(np.isnan(passing), began_s + elapsed_s, passing)
            position += velocity * duration_s + 0.5 * acceleration * duration_s**2
            velocity += acceleration * duration_s
            began_s += duration_s
        return passing


def _first_root(
    distance: NDArray[np.float64], velocity: float, acceleration: float, duration_s: float
) -> NDArray[np.float64]:
    """Return the time from 0 to ``duration_s`` after which ``distance`` is covered, else NaN."""
    slack_s = 1e-9 * duration_s
    discriminant = velocity * velocity + 2.0 * acceleration * distance
    # At the turning point rounding may leave a negative number.
    rounding = 1e-12 * (velocity * velocity + np.abs(2.0 * acceleration * distance))
    root = np.sqrt(np.where(np.abs(discriminant) <= rounding, 0.0, discriminant))
    q = -0.5 * (velocity + math.copysign(1.0, velocity) * root)
    candidates = np.stack((np.divide(q, np.float64(0.5 * acceleration)), np.divide(-distance, q)))
    valid = (candidates >= -slack_s) & (candidates <= duration_s + slack_s)
    first = np.where(valid, candidates, np.inf).min(axis=0)
    return np.where(np.isfinite(first), np.clip(first, 0.0, duration_s), np.nan)


def plan_move(
    start_ns: int,
    position_mm: float,
    target_mm: float,
    speed_mm_s: float,
    acceleration_mm_s2: float,
) -> MotionPlan:
    """Return the trapezoid from rest at ``position_mm`` to rest at ``target_mm``.

    Raises ``ArgumentError`` when speed or acceleration is not positive or a value is not finite.
    """
    for name, place in (("position_mm", position_mm), ("target_mm", target_mm)):
        number(name, place, -POSITION_LIMIT_MM, POSITION_LIMIT_MM)
    positive("speed_mm_s", speed_mm_s)
    positive("acceleration_mm_s2", acceleration_mm_s2)
    distance = abs(target_mm - position_mm)
    sign = math.copysign(1.0, target_mm - position_mm)
    peak = min(speed_mm_s, math.sqrt(distance * acceleration_mm_s2))
    ramp_s = peak / acceleration_mm_s2
    # Where the ramps meet, rounding may leave a negative cruise.
    cruise_s = max(distance / peak - ramp_s, 0.0) if peak > 0.0 else 0.0
    return MotionPlan(
        start_ns,
        position_mm,
        0.0,
        (ramp_s, cruise_s, ramp_s),
        (sign * acceleration_mm_s2, 0.0, -sign * acceleration_mm_s2),
    )


def plan_stop(plan: MotionPlan, at_ns: int, deceleration_mm_s2: float) -> MotionPlan:
    """Return the profiled stop of ``plan`` from ``at_ns`` on.

    Raises ``ArgumentError`` when the deceleration is not positive.
    """
    positive("deceleration_mm_s2", deceleration_mm_s2)
    integer("at_ns", at_ns, -TIME_LIMIT, TIME_LIMIT)
    position, velocity = plan.state(at_ns)
    speed = float(velocity)
    if speed == 0.0:
        return MotionPlan(at_ns, float(position))
    return MotionPlan(
        at_ns,
        float(position),
        speed,
        (abs(speed) / deceleration_mm_s2,),
        (-math.copysign(deceleration_mm_s2, speed),),
    )
