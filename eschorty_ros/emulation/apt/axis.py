"""The emulated carriage: trapezoids, limits, homing, and the pulses on its way."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from eschorty_ros.core.clocks import MotionPlan, plan_move, plan_stop
from eschorty_ros.hardware.stage.apt_messages import Scale

SAMPLING_NS = 102_400
EMERGENCY_MM_S2 = 14_883.0
_HISTORY_NS = 60_000_000_000


@dataclass(frozen=True, slots=True)
class PulsePattern:
    """Position pulses as programmed, in mm of the encoder.

    Parameters
    ----------
    forward, reverse : tuple of float, float, int
        First position, interval, count of each direction.
    width_ns : int
    """

    forward: tuple[float, float, int] | None
    reverse: tuple[float, float, int] | None
    width_ns: int


def pulse_pattern(
    pulses: dict[str, int], forward: bool, reverse: bool, scale: Scale
) -> PulsePattern:
    """Pattern of a trigger message's fields, for the directions that are switched on."""
    steps: list[tuple[float, float, int] | None] = []
    for sense, on in (("forward", forward), ("reverse", reverse)):
        first, interval, count = (
            pulses[f"{field}_{sense}"] for field in ("start", "interval", "count")
        )
        wanted = on and interval > 0
        steps.append((scale.mm(first), scale.mm(interval), count) if wanted else None)
    return PulsePattern(steps[0], steps[1], pulses["width_us"] * 1000)


def stage_data(
    travel_mm: float, speed_mm_s: float, acceleration_mm_s2: float, scale: Scale
) -> dict[str, int | bytes]:
    """Fields of the stage data of a DDS220."""
    return {
        "channel": 1,
        "part": b"DDS220",
        "serial": 45_000_001,
        "counts_per_unit": round(scale.counts_per_mm),
        "maximum": scale.position(travel_mm),
        "acceleration": scale.acceleration(acceleration_mm_s2),
        "deceleration": scale.acceleration(EMERGENCY_MM_S2),
        "velocity": scale.velocity(speed_mm_s),
    }


class Axis:
    """Where the carriage truly is; ``travel_mm`` are the hard ends.

    Parameters
    ----------
    at_ns : int
    position_mm : float
    travel_mm : tuple of float
    on_plan : callable
        Told every new motion.
    sampled_pulses : bool
        Whether pulses begin at the controller's next cycle of 102.4 us only.
    """

    def __init__(
        self,
        at_ns: int,
        position_mm: float,
        travel_mm: tuple[float, float],
        on_plan: Callable[[MotionPlan], None],
        sampled_pulses: bool = False,
    ) -> None:
        self.travel_mm = travel_mm
        self.obstacle_mm: float | None = None
        self.pattern: PulsePattern | None = None
        self.stalled = False
        self.encoder_offset_mm = position_mm
        self._on_plan = on_plan
        self._sampled = sampled_pulses
        self._plans: deque[MotionPlan] = deque()
        self._follow(MotionPlan(at_ns, position_mm))

    @property
    def plan(self) -> MotionPlan:
        """The motion under way, or the last one."""
        return self._plans[-1]

    def position_mm(self, at_ns: int) -> float:
        """Tell the true position."""
        return float(self._plan_at(at_ns).state(at_ns)[0])

    def velocity_mm_s(self, at_ns: int) -> float:
        """Tell the true velocity."""
        return float(self._plan_at(at_ns).state(at_ns)[1])

    def encoder_mm(self, at_ns: int) -> float:
        """Read the encoder."""
        return self.position_mm(at_ns) - self.encoder_offset_mm

    def bits(self, at_ns: int, ordered: bool, enabled: bool) -> int:
        """Status bits of limits and motion; ``ordered`` while an order is being carried out."""
        velocity = self.velocity_mm_s(at_ns)
        here, (low, high) = self.position_mm(at_ns), self.travel_mm
        blocked = self.obstacle_mm is not None and abs(here - self.obstacle_mm) < 1e-6
        return sum(
            mask
            for mask, holds in (
                (0x0001, here >= high + 1e-6 or blocked),
                (0x0002, here <= low - 1e-6),
                (0x0010, ordered and velocity > 0.0),
                (0x0020, ordered and velocity < 0.0),
                (0x2000, enabled and not ordered),
                (0x4000, self.stalled and ordered),
            )
            if holds
        )

    def moving(self, at_ns: int) -> bool:
        """Whether the motion is not over."""
        return at_ns < self.plan.end_ns

    def move(self, at_ns: int, target_mm: float, speed: float, acceleration: float) -> None:
        """Trapezoid from where it rests; a hard end or an obstacle on the way stops it short."""
        low, high = self.travel_mm
        here = self.position_mm(at_ns)
        target = min(max(target_mm, low), high)
        plan = plan_move(at_ns, here, target, speed, acceleration)
        if (
            self.obstacle_mm is not None
            and (here - self.obstacle_mm) * (target - self.obstacle_mm) < 0.0
        ):
            plan = _cut(plan, float(plan.passing_s([self.obstacle_mm])[0]))
        self._follow(plan)

    def stop(self, at_ns: int, deceleration: float) -> None:
        """Ramp down from now on; nothing happens at rest."""
        if self.moving(at_ns):
            self._follow(plan_stop(self.plan, at_ns, deceleration))

    def freeze(self, at_ns: int) -> None:
        """Stand still at once, as a blocked carriage does."""
        self.stalled = True
        self._follow(MotionPlan(at_ns, self.position_mm(at_ns)))

    def pulses(self, from_ns: int, until_ns: int) -> list[tuple[int, bool]]:
        """Edges of the trigger output from ``from_ns`` to before ``until_ns``: time, rising."""
        pattern = self.pattern
        if pattern is None:
            return []
        edges: list[tuple[int, bool]] = []
        ends = [*(plan.start_ns for plan in list(self._plans)[1:]), math.inf]
        for plan, end_ns in zip(self._plans, ends, strict=True):
            if min(plan.end_ns, end_ns) + SAMPLING_NS + pattern.width_ns < from_ns:
                continue
            for rise_ns in self._rises(plan, pattern):
                if rise_ns < end_ns:
                    edges += [(rise_ns, True), (rise_ns + pattern.width_ns, False)]
        return sorted(edge for edge in edges if from_ns <= edge[0] < until_ns)

    def _rises(self, plan: MotionPlan, pattern: PulsePattern) -> list[int]:
        travelled = plan.end_mm - plan.position_mm
        steps = pattern.forward if travelled > 0.0 else pattern.reverse
        if travelled == 0.0 or steps is None:
            return []
        first, interval, count = steps
        interval = math.copysign(interval, travelled)
        places = self.encoder_offset_mm + first + interval * np.arange(count)
        passing_s = plan.passing_s(places)
        rises = plan.start_ns + np.rint(passing_s[passing_s > 0.0] * 1e9).astype(np.int64)
        if self._sampled:
            rises = -(-rises // SAMPLING_NS) * SAMPLING_NS
        return [int(rise) for rise in rises]

    def _plan_at(self, at_ns: int) -> MotionPlan:
        for plan in reversed(self._plans):
            if plan.start_ns <= at_ns:
                return plan
        return self._plans[0]

    def _follow(self, plan: MotionPlan) -> None:
        while self._plans and self._plans[0].end_ns < plan.start_ns - _HISTORY_NS:
            self._plans.popleft()
        self._plans.append(plan)
        self._on_plan(plan)


def _cut(plan: MotionPlan, after_s: float) -> MotionPlan:
    """``plan`` that ends all at once."""
    durations = []
    for duration_s in plan.durations_s:
        durations.append(min(duration_s, max(after_s, 0.0)))
        after_s -= duration_s
    return replace(plan, durations_s=tuple(durations))
