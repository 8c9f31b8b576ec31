"""State of the axis from its status messages: position, the motion under way, failures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.core.clocks import MotionFit
from eschorty_ros.hardware.base.protocols import StageState
from eschorty_ros.hardware.stage import apt_messages as apt
from eschorty_ros.hardware.stage.apt_status import LATE_NS, Plausibility, Status, StatusChecks

BYTE_NS = 86_806
REQUEST_NS = 6 * BYTE_NS
ANSWER_NS = 20 * BYTE_NS
WARN_AGE_NS = 500_000_000
FAULT_AGE_NS = 1_500_000_000
_TOLERANCE_MM = 1e-3
_STALL_NS = 200_000_000
_BEGIN_NS = 300_000_000
# A limit this near to where a move began is the one it leaves.
_LIMIT_LEFT_MM = 1.0
_READINGS_AT_REST = 2
_POLL_LOST_NS = 250_000_000
# Larger than any drift between two messages and any step of a simulated clock.
_CLOCK_SET_NS = 500_000_000
# After a stall of the host, statuses may still wait to be read: this many checks come first.
_LATE_CHECKS_MIN = 5
_AGE_CHECKS_MIN = 20


class Kind(Enum):
    """Kind of an ordered motion."""

    HOME = "homing"
    MOVE = "move"
    STOP = "stop"


class Outcome(Enum):
    """State of an ordered motion as of a status message."""

    GOING = auto()
    ENDED = auto()
    MET_LIMIT = auto()
    NOT_BEGUN = auto()
    LATE = auto()
    STUCK = auto()


class Actions(Protocol):
    """Actions that the tracker requests because of a status message."""

    def request_status(self) -> None:
        """Request another status message."""

    def stop(self) -> None:
        """Begin a profiled stop."""

    def fail(self, error: DeviceError, escalate: bool = False) -> None:
        """Stop for good; ``escalate`` when the carriage may not obey."""


class Tracker:
    """State of the axis; not thread-safe.

    - ``now_ns``: Steady clock.
    - ``clock_ns``: Clock of ``StageState.t_ns``.

    Public attributes:
    - ``motion``: The motion under way.
    - ``status``: The newest message that was used.
    - ``blocked_sense``: Sign of the direction that a limit has barred.
    - ``command_errors``: Times the controller began to report a refused command.
    - ``clock_sets``: Times the clock was set. The rest of a motion under way then follows readings
      alone.
    """

    def __init__(
        self, actions: Actions, now_ns: Callable[[], int], clock_ns: Callable[[], int]
    ) -> None:
        self.scale = apt.Scale()
        self.fit = MotionFit(_TOLERANCE_MM)
        self.checks = StatusChecks()
        self.motion: Motion | None = None
        self.status: Status | None = None
        self.failure: DeviceError | None = None
        self.blocked_sense = 0
        self.command_errors = 0
        self.clock_sets = 0
        self._actions = actions
        self._now_ns, self._clock_ns = now_ns, clock_ns
        self._status_ns: int | None = None
        self._offset_ns: int | None = None
        self._requests_ns: deque[int] = deque()
        self._requested_ns: int | None = None
        self._answers_late_until_ns = 0
        self._rest_ns = 0
        self._known_from_ns = 0
        self._age_checks = 0

    @property
    def age_ns(self) -> int:
        """Return the time since the last status message, 0 before the first."""
        return 0 if self._status_ns is None else self._now_ns() - self._status_ns

    @property
    def late(self) -> bool:
        """Return whether status messages do not come although this process runs."""
        age_ns = self.age_ns
        checked = self._age_checks >= _LATE_CHECKS_MIN or age_ns > FAULT_AGE_NS
        return age_ns > WARN_AGE_NS and checked

    @property
    def homing(self) -> bool:
        """Return whether the axis moves to its reference."""
        return self.motion is not None and self.motion.kind is Kind.HOME

    @property
    def enabled(self) -> bool:
        """Return whether the axis is enabled."""
        return self.status is not None and bool(self.status.bits & apt.ENABLED)

    def begin_motion(
        self, kind: Kind, start_mm: float, target_mm: float, speed: float, limit_s: float
    ) -> None:
        """Expect a motion that ends within ``limit_s``."""
        now_ns = self._now_ns()
        deadline_ns = now_ns + round(limit_s * 1e9)
        self.motion = Motion(kind, start_mm, target_mm, speed, now_ns, deadline_ns)

    def begin_stop(self, deceleration_mm_s2: float) -> None:
        """Expect the motion under way to end in a ramp."""
        motion = self.motion
        if motion is None:
            return
        if motion.kind is Kind.MOVE:
            self.fit.expect_stop(self._clock_ns() + REQUEST_NS, deceleration_mm_s2)
        motion.stop()

    def begin_poll(self) -> bool:
        """Return whether to request a status; if so, the request must be sent at once."""
        now_ns = self._now_ns()
        # One at a time, so that an answer belongs to its request.
        if self._requested_ns is not None:
            if now_ns - self._requested_ns < _POLL_LOST_NS:
                return False
            # Its answer may still come, and must not count as the next one's.
            self._answers_late_until_ns = now_ns + LATE_NS
        elif now_ns >= self._answers_late_until_ns:
            self._requests_ns.clear()
        self._requests_ns.append(self._clock_ns())
        self._requested_ns = now_ns
        return True

    def state(self, t_ns: int | None, lag_ns: int) -> StageState:
        """Return the state at ``t_ns``, by default the newest that is known, ``lag_ns`` ago."""
        until_ns, status = self.fit.until_ns, self.status
        assert until_ns is not None
        assert status is not None
        requested_ns = self._clock_ns() - lag_ns if t_ns is None else t_ns
        t_ns = min(max(requested_ns, self._known_from_ns), until_ns)
        position, velocity = (float(value) for value in self.fit.state(t_ns))
        flags = apt.decode_bits(status.bits)
        if self.late:
            flags = (*flags, "status_late")
        moving = self.motion is not None or t_ns < self._rest_ns
        homed = bool(status.bits & apt.HOMED) and not self.homing
        return StageState(position, velocity, t_ns, homed, moving, flags)

    def check_age(self) -> None:
        """Fail when status messages do not come any more."""
        self._age_checks += 1
        if self.age_ns > FAULT_AGE_NS and self._age_checks >= _AGE_CHECKS_MIN:
            self._actions.fail(
                DeviceGoneError(
                    f"the stage controller sent no status for {FAULT_AGE_NS * 1e-9:g} s; check "
                    "its power and cable"
                )
            )

    def add_status(self, frame: apt.Frame, received_ns: int, clock_ns: int) -> None:
        """Use one status message, received at this time of both clocks."""
        latest_ns = clock_ns - ANSWER_NS
        position_mm = self.scale.mm(frame.integer("position"))
        self._follow_clock(position_mm, latest_ns, clock_ns - received_ns)
        # Answers keep the order of their requests. One that is lost leaves a request too early for
        # the answer after it, which is a bound all the same.
        earliest_ns = None
        if self._requests_ns:
            earliest_ns = min(self._requests_ns.popleft() + REQUEST_NS, latest_ns)
        self._requested_ns = None
        status = Status(position_mm, frame.integer("bits"), earliest_ns, latest_ns)
        self._status_ns, self._age_checks = received_ns, 0
        motion = self.motion
        expected = None
        if motion is None and self.status is not None:
            expected = (self.status.position_mm, self.status.position_mm)
        elif motion is not None and motion.kind is not Kind.HOME:
            expected = self.fit.expected_mm(status.not_before_ns, latest_ns)
        speed = 0.0 if motion is None else motion.speed_mm_s
        if self.status is None or self.failure is not None:
            self.checks.reset()
        match self.checks.check(status, expected, speed):
            case Plausibility.REPEAT:
                self._actions.request_status()
            case Plausibility.CONTRADICTORY:
                self._actions.fail(
                    DeviceError(
                        "two status messages of the stage in a row are implausible; check the "
                        "cable for interference"
                    )
                )
            case plausibility:
                self._use(status, plausibility)

    def _follow_clock(self, position_mm: float, latest_ns: int, offset_ns: int) -> None:
        """Drop the positions so far when the clock was set since the last message."""
        before_ns, self._offset_ns = self._offset_ns, offset_ns
        if before_ns is None or abs(offset_ns - before_ns) < _CLOCK_SET_NS:
            return
        self.clock_sets += 1
        self._requests_ns.clear()
        self._requested_ns = None
        self._rest_ns += offset_ns - before_ns
        self._restart_fit(position_mm, latest_ns, None)
        self.checks.reset()

    def _restart_fit(self, position_mm: float, latest_ns: int, earliest_ns: int | None) -> None:
        self.fit = MotionFit(_TOLERANCE_MM)
        self.fit.add_reading(position_mm, latest_ns, earliest_ns)
        self._known_from_ns = self.fit.until_ns or 0

    def _use(self, status: Status, plausibility: Plausibility) -> None:
        before, self.status = self.status, status
        known = 0 if before is None else before.bits
        self.command_errors += bool(status.bits & ~known & apt.COMMAND_ERROR)
        if self.failure is not None:
            if before is not None and before.position_mm == status.position_mm:
                self.motion = None
            return
        error = self._error_of(before, status, plausibility)
        if error is not None:
            self._actions.fail(error)
            return
        if not (self.homing and status.bits & apt.HOMED):
            self.fit.add_reading(status.position_mm, status.latest_ns, status.earliest_ns)
        if self.motion is not None:
            self._follow_motion(self.motion, before, status, plausibility)

    def _error_of(
        self, before: Status | None, status: Status, plausibility: Plausibility
    ) -> DeviceError | None:
        if before is not None and not self.homing:
            lost = before.bits & ~status.bits
            if lost & (apt.HOMED | apt.ENABLED):
                what = "its reference" if lost & apt.HOMED else "the axis enabled"
                return DeviceError(
                    f"the stage controller does not have {what} any more, as after a restart; "
                    "configure and home again"
                )
            if plausibility is Plausibility.JUMPED:
                jump_mm = status.position_mm - before.position_mm
                return DeviceError(
                    f"the stage's encoder jumped by {jump_mm:.3f} mm; home again and check the "
                    "encoder's cable"
                )
        if faults := apt.axis_faults(status.bits):
            names = ", ".join(apt.decode_bits(faults))
            return DeviceError(f"the stage controller reports {names}; clear its cause")
        return None

    def _follow_motion(
        self, motion: Motion, before: Status | None, status: Status, plausibility: Plausibility
    ) -> None:
        what, at_mm = motion.kind.value, status.position_mm
        assert self._offset_ns is not None
        match motion.update(before, status, plausibility, self._offset_ns):
            case Outcome.MET_LIMIT:
                self.blocked_sense = motion.sense
                self._actions.stop()
            case Outcome.ENDED:
                self._end(motion, status)
            case Outcome.NOT_BEGUN:
                self._actions.fail(
                    DeviceError(
                        f"the stage does not begin its {what} within {_BEGIN_NS * 1e-9:g} s; check "
                        "its front panel, the interlock and the motor cable"
                    )
                )
            case Outcome.LATE:
                self._actions.fail(
                    DeviceError(
                        f"the stage's {what} does not end in time; check the travel for obstacles, "
                        "then configure again"
                    )
                )
            case Outcome.STUCK:
                self._actions.fail(
                    DeviceError(
                        f"the stage is stuck at {at_mm:.3f} mm on its {what} to "
                        f"{motion.target_mm:.3f} mm; check the travel for obstacles, then "
                        "configure again"
                    ),
                    escalate=True,
                )

    def _end(self, motion: Motion, status: Status) -> None:
        self.motion = None
        self._rest_ns = status.latest_ns
        if status.bits & apt.HOMED and motion.kind is Kind.HOME:
            # Before, the encoder counted from another zero.
            self._restart_fit(status.position_mm, status.latest_ns, status.earliest_ns)
            return
        planned_mm = float(self.fit.state(status.latest_ns)[0])
        if abs(planned_mm - status.position_mm) > _TOLERANCE_MM:
            self.fit.discard_motion()
        if self.blocked_sense and motion.sense == -self.blocked_sense:
            self.blocked_sense = 0


@dataclass(slots=True)
class Motion:
    """One ordered motion; times are the link's steady ones (ns)."""

    kind: Kind
    start_mm: float
    target_mm: float
    speed_mm_s: float
    begun_ns: int
    deadline_ns: int
    ended_by_message: bool = False
    _seen_moving: bool = False
    _resting: int = 0
    _late: int = 0
    _wrong_since_ns: int | None = None

    @property
    def sense(self) -> int:
        """Return the sign of its direction."""
        return (self.target_mm > self.start_mm) - (self.target_mm < self.start_mm)

    def stop(self) -> None:
        """Expect the motion to end anywhere."""
        self.kind, self._resting = Kind.STOP, 0

    def update(
        self, before: Status | None, status: Status, plausibility: Plausibility, offset_ns: int
    ) -> Outcome:
        """Return the outcome as of a status message and the one before it.

        ``offset_ns`` is the lead of the statuses' clock over the steady one. A status that is
        received late, after a stall of the host, shows nothing of the time since it was taken.
        """
        not_before_ns = status.not_before_ns - offset_ns
        frozen = (
            before is not None and abs(status.position_mm - before.position_mm) <= _TOLERANCE_MM
        )
        rests = frozen and not status.bits & (apt.MOVING | apt.INITIALISING)
        arrived = abs(status.position_mm - self.target_mm) <= _TOLERANCE_MM
        homing = self.kind is Kind.HOME
        self._seen_moving |= not rests and before is not None
        if homing:
            self._seen_moving |= not status.bits & apt.HOMED
        settled = bool(status.bits & apt.SETTLED) or arrived or self.kind is Kind.STOP
        self._resting = self._resting + 1 if rests and settled else 0
        if self._meets_limit(status, arrived):
            return Outcome.MET_LIMIT
        if self._resting >= _READINGS_AT_REST and self._is_complete(status, arrived):
            return Outcome.ENDED
        self._late += not_before_ns > self.deadline_ns
        # After a stall of the host the first late readings show whether the stage rests.
        if self._late > _READINGS_AT_REST:
            return Outcome.LATE
        if self.kind is Kind.STOP:
            return Outcome.GOING
        if not self._seen_moving and not_before_ns - self.begun_ns > _BEGIN_NS:
            return Outcome.NOT_BEGUN
        wrong = bool(status.bits & apt.POSITION_ERROR)
        if not homing:
            wrong |= plausibility is Plausibility.OFF_PATH
            wrong |= frozen and self._seen_moving and not arrived
        if not wrong:
            self._wrong_since_ns = None
            return Outcome.GOING
        if self._wrong_since_ns is None:
            self._wrong_since_ns = status.latest_ns - offset_ns
        stuck_ns = not_before_ns - self._wrong_since_ns
        return Outcome.STUCK if stuck_ns >= _STALL_NS else Outcome.GOING

    def _is_complete(self, status: Status, arrived: bool) -> bool:
        """Return whether rest is the end: by a message, or at the target."""
        if self.kind is Kind.HOME:
            begun = self._seen_moving or self.ended_by_message
            return begun and bool(status.bits & apt.HOMED)
        return self.kind is Kind.STOP or arrived or self.ended_by_message

    def _meets_limit(self, status: Status, arrived: bool) -> bool:
        return (
            self.kind is Kind.MOVE
            and bool(status.bits & apt.LIMITS)
            and not arrived
            and abs(status.position_mm - self.start_mm) > _LIMIT_LEFT_MM
        )
