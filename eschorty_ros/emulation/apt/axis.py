"""The emulated carriage: trapezoids, limits, homing, and position pulses."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.clocks.motion import MotionPlan, plan_move, plan_stop

SAMPLING_NS = 102_400
EMERGENCY_MM_S2 = 14_883.0
_HISTORY_NS = 60_000_000_000


@dataclass(frozen=True, slots=True)
class PulseLeg:
    """Pulses in one direction, ``sense`` 1 or -1, each so far on from the one before."""

    sense: int
    start_mm: float
    interval_mm: float
    count: int


@dataclass(frozen=True, slots=True)
class PulseSequence:
    """Position pulses as programmed, in mm of the encoder: the legs in turn, ``cycles`` times."""

    legs: tuple[PulseLeg, ...]
    cycles: int
    width_ns: int

    def ahead_mm(self, given: int, sense: int) -> NDArray[np.float64]:
        """Return the positions left of the leg that is due, if a motion of this sense gives them.

        - ``given``: Pulses since the sequence began.
        """
        per_cycle = sum(leg.count for leg in self.legs)
        if given < self.cycles * per_cycle:
            given %= per_cycle
            for leg in self.legs:
                if given < leg.count:
                    left = np.arange(given, leg.count if sense == leg.sense else given, dtype=float)
                    return leg.start_mm + leg.sense * leg.interval_mm * left
                given -= leg.count
        return np.empty(0)


class Axis:
    """The true motion of the carriage, and the pulses of its trigger output.

    The trigger output is a sequencer: it waits for one position at a time, so that a pulse whose
    position is never passed in its direction keeps back all that follow.

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
        sampled_pulses: bool,
    ) -> None:
        self.travel_mm = travel_mm
        self.obstacle_mm: float | None = None
        self.stalled = False
        self.encoder_offset_mm = position_mm
        self._on_plan = on_plan
        self._sampled = sampled_pulses
        self._sequence: PulseSequence | None = None
        # Pulses of the sequence, and edges of all, up to a time.
        self._given = 0
        self._edges: deque[tuple[int, bool]] = deque()
        self._given_ns = at_ns
        self._plans = deque((MotionPlan(at_ns, position_mm),))
        on_plan(self.plan)

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

    def zero_encoder(self, at_ns: int) -> None:
        """Let the encoder read 0 at the lower hard end, from now on."""
        self._give_pulses(at_ns)
        self.encoder_offset_mm = self.travel_mm[0]

    def begin_pulses(self, at_ns: int, sequence: PulseSequence | None) -> None:
        """Wait for the first pulse of a sequence from now on, for none with ``None``."""
        self._give_pulses(at_ns)
        self._sequence, self._given = sequence, 0

    def pulses(self, from_ns: int, until_ns: int) -> list[tuple[int, bool]]:
        """Return the trigger edges from ``from_ns`` to before ``until_ns``: time, rising."""
        edges = [*self._edges, *self._edges_until(until_ns)]
        return sorted(edge for edge in edges if from_ns <= edge[0] < until_ns)

    def _give_pulses(self, until_ns: int) -> None:
        """Give the pulses that are due, before the motion or the sequence changes."""
        edges = self._edges_until(until_ns)
        self._given += len(edges) // 2
        self._given_ns = max(until_ns, self._given_ns)
        while self._edges and self._edges[0][0] < until_ns - _HISTORY_NS:
            self._edges.popleft()
        self._edges.extend(edges)

    def _edges_until(self, until_ns: int) -> list[tuple[int, bool]]:
        """Return the edges of the motion under way from the pulses given on."""
        plan, sequence = self.plan, self._sequence
        travelled_mm = plan.end_mm - plan.position_mm
        if sequence is None or travelled_mm == 0.0:
            return []
        ahead_mm = sequence.ahead_mm(self._given, 1 if travelled_mm > 0.0 else -1)
        passing_s = np.nan_to_num(plan.passing_s(self.encoder_offset_mm + ahead_mm), nan=0.0)
        at_ns = plan.start_ns + np.rint(passing_s * 1e9).astype(np.int64)
        passed = (passing_s > 0.0) & (at_ns >= self._given_ns) & (at_ns < until_ns)
        # One position at a time: the first that is not passed keeps back all that follow.
        rises = at_ns[: int(np.argmin(np.append(passed, False)))]
        if self._sampled:
            rises = -(-rises // SAMPLING_NS) * SAMPLING_NS
        return [
            edge
            for rise in rises.tolist()
            for edge in ((rise, True), (rise + sequence.width_ns, False))
        ]

    def _plan_at(self, at_ns: int) -> MotionPlan:
        for plan in reversed(self._plans):
            if plan.start_ns <= at_ns:
                return plan
        return self._plans[0]

    def _follow(self, plan: MotionPlan) -> None:
        self._give_pulses(plan.start_ns)
        while len(self._plans) > 1 and self._plans[1].start_ns < plan.start_ns - _HISTORY_NS:
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
