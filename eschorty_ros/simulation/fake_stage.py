"""A linear stage that exists in memory only."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.core.motion import MotionPlan, plan_move, plan_stop
from eschorty_ros.hardware.protocols import DeviceIdentity, PulseTrain, StageState

_HOMING_MM_S = 100.0


class FakeStage:
    """Emulated linear stage with trapezoidal moves; positions mean nothing before homing.

    Thread-safe. Every motion is a plan in the time of ``clock_ns``, so that another process that
    holds the plan knows the position exactly.

    Parameters
    ----------
    clock_ns : callable
    travel_mm : tuple of float
        Lower and upper end.
    speed_max_mm_s, acceleration_mm_s2 : float
    power_up_mm : float
        Where the carriage stands at construction.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        travel_mm: tuple[float, float] = (0.0, 220.0),
        speed_max_mm_s: float = 300.0,
        acceleration_mm_s2: float = 2000.0,
        power_up_mm: float = 5.0,
    ) -> None:
        self.identity = DeviceIdentity("simulated linear stage", "SIM-STAGE")
        self.trigger: PulseTrain | None = None
        self.travel_mm = travel_mm
        self.speed_max_mm_s = speed_max_mm_s
        self.acceleration_mm_s2 = acceleration_mm_s2
        self._clock_ns = clock_ns
        self._lock = threading.Lock()
        self._plan = MotionPlan(clock_ns(), power_up_mm)
        self._home_ns: int | None = None
        self._closed = False

    def home(self) -> None:
        """Start homing to the lower end; raises ``DeviceError`` when closed or moving."""
        with self._lock:
            now_ns = self._ready()
            self._plan = self._planned(now_ns, self.travel_mm[0], _HOMING_MM_S)
            self._home_ns = self._plan.end_ns

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Start a move; raises ``DeviceError`` outside travel, too fast, not homed or moving."""
        with self._lock:
            now_ns = self._ready()
            if not self._homed(now_ns):
                raise DeviceError("the stage is not homed; home it before moving")
            low, high = self.travel_mm
            if not low <= position_mm <= high:
                raise DeviceError(
                    f"position_mm is {position_mm!r}; the travel is {low:g} to {high:g} mm"
                )
            if not 0.0 < speed_mm_s <= self.speed_max_mm_s:
                raise DeviceError(
                    f"speed_mm_s is {speed_mm_s!r}; choose above 0 to {self.speed_max_mm_s:g} mm/s"
                )
            self._plan = self._planned(now_ns, position_mm, speed_mm_s)

    def stop(self) -> None:
        """Profiled stop; idempotent. A stopped homing has to be started again."""
        with self._lock:
            now_ns = self._clock_ns()
            if now_ns >= self._plan.end_ns:
                return
            if not self._homed(now_ns):
                self._home_ns = None
            self._plan = plan_stop(self._plan, now_ns, self.acceleration_mm_s2)

    healthy = True

    def statistics(self) -> dict[str, float]:
        """Nothing is counted."""
        return {}

    def state(self, t_ns: int | None = None) -> StageState:
        """Position, velocity and flags at ``t_ns``, by default now."""
        with self._lock:
            now_ns = self._clock_ns() if t_ns is None else t_ns
            position, velocity = (float(value) for value in self._plan.state(now_ns))
            moving = now_ns < self._plan.end_ns
            low, high = self.travel_mm
            flags = [
                name
                for name, holds in (
                    ("at_lower_limit", math.isclose(position, low, abs_tol=1e-6)),
                    ("at_upper_limit", math.isclose(position, high, abs_tol=1e-6)),
                    ("homing", moving and self._home_ns == self._plan.end_ns),
                    ("closed", self._closed),
                )
                if holds
            ]
            return StageState(position, velocity, now_ns, self._homed(now_ns), moving, tuple(flags))

    def plan(self) -> MotionPlan:
        """Tell the motion under way or the rest after it."""
        with self._lock:
            return self._plan

    def close(self) -> None:
        """Stop and release; idempotent."""
        self.stop()
        with self._lock:
            self._closed = True

    def _homed(self, now_ns: int) -> bool:
        return self._home_ns is not None and now_ns >= self._home_ns

    def _ready(self) -> int:
        if self._closed:
            raise DeviceError("the stage is closed; open it again")
        now_ns = self._clock_ns()
        if now_ns < self._plan.end_ns:
            raise DeviceError("the stage is moving; stop it or wait before the next move")
        return now_ns

    def _planned(self, now_ns: int, target_mm: float, speed_mm_s: float) -> MotionPlan:
        return plan_move(now_ns, self._plan.end_mm, target_mm, speed_mm_s, self.acceleration_mm_s2)
