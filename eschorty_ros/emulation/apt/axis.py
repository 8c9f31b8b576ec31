"""The emulated carriage: trapezoids, limits, homing, and position pulses."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from eschorty_ros.core.clocks.motion import MotionPlan, plan_move, plan_stop
from eschorty_ros.core.clocks.pulses import PulseTrain

SAMPLING_NS = 102_400
EMERGENCY_MM_S2 = 14_883.0
_HISTORY_NS = 60_000_000_000


@dataclass(frozen=True, slots=True)
class PulsePattern:
    """Position pulses as programmed, for each direction, in mm of the encoder."""

    forward: PulseTrain | None
    reverse: PulseTrain | None
    width_ns: int


class Axis:
    """The true motion of the carriage.

    - ``travel_mm``: Hard ends.
    - ``on_plan``: Called with every new motion.
    - ``sampled_pulses``: Pulses begin at the controller's next cycle of 102.4 us only.
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
        """Return the motion under way, or the last one."""
        return self._plans[-1]

    def position_mm(self, at_ns: int) -> float:
        """Return the true position."""
        return float(self._plan_at(at_ns).state(at_ns)[0])

    def velocity_mm_s(self, at_ns: int) -> float:
        """Return the true velocity."""
        return float(self._plan_at(at_ns).state(at_ns)[1])

    def encoder_mm(self, at_ns: int) -> float:
        """Return the encoder's position."""
        return self.position_mm(at_ns) - self.encoder_offset_mm

    def bits(self, at_ns: int, ordered: bool, enabled: bool) -> int:
        """Return status bits of limits and motion; ``ordered`` while an order is carried out."""
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
        """Return whether the motion has not ended."""
        return at_ns < self.plan.end_ns

    def move(self, at_ns: int, target_mm: float, speed: float, acceleration: float) -> None:
        """Begin a trapezoid from rest; a hard end or an obstacle on the way stops it short."""
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
        """Halt at once, as a blocked carriage does."""
        self.stalled = True
        self._follow(MotionPlan(at_ns, self.position_mm(at_ns)))

    def pulses(self, from_ns: int, until_ns: int) -> list[tuple[int, bool]]:
        """Return the trigger edges from ``from_ns`` to before ``until_ns``: time, rising."""
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
        train = pattern.forward if travelled > 0.0 else pattern.reverse
        if travelled == 0.0 or train is None:
            return []
        positions = train.first_mm + train.interval_mm * np.arange(train.count)
        passing_s = plan.passing_s(self.encoder_offset_mm + positions)
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
    """Return ``plan`` with an abrupt end."""
    durations = []
    for duration_s in plan.durations_s:
        durations.append(min(duration_s, max(after_s, 0.0)))
        after_s -= duration_s
    return replace(plan, durations_s=tuple(durations))
