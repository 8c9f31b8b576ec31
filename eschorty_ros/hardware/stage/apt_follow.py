"""A motion under way, followed by its status messages: begun, going, ended, stuck."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from eschorty_ros.hardware.stage import apt_messages as apt
from eschorty_ros.hardware.stage.apt_judge import Status, Verdict

TOLERANCE_MM = 1e-3
STALL_NS = 200_000_000
BEGIN_NS = 300_000_000
# A limit this near to where a move began is the one it leaves.
_LIMIT_LEFT_MM = 1.0
_READINGS_AT_REST = 2


class Kind(Enum):
    """What was ordered."""

    HOME = "homing"
    MOVE = "move"
    STOP = "stop"


class Outcome(Enum):
    """What has become of it."""

    GOING = auto()
    ENDED = auto()
    MET_LIMIT = auto()
    NOT_BEGUN = auto()
    LATE = auto()
    STUCK = auto()


@dataclass(slots=True)
class Motion:
    """One ordered motion; times are the link's steady ones (ns).

    Parameters
    ----------
    kind : Kind
    start_mm, target_mm : float
    speed_mm_s : float
    begun_ns, deadline_ns : int
    """

    kind: Kind
    start_mm: float
    target_mm: float
    speed_mm_s: float
    begun_ns: int
    deadline_ns: int
    ended_by_message: bool = False
    _seen_moving: bool = False
    _resting: int = 0
    _wrong_since_ns: int | None = None

    @property
    def sense(self) -> int:
        """Sign of the way to go."""
        return (self.target_mm > self.start_mm) - (self.target_mm < self.start_mm)

    def stop(self) -> None:
        """Expect it to end anywhere."""
        self.kind, self._resting = Kind.STOP, 0

    def follow(
        self, before: Status | None, status: Status, verdict: Verdict, offset_ns: int
    ) -> Outcome:
        """Learn from a status message that is believed, and the one before it.

        ``offset_ns`` is what the statuses' clock is ahead of the steady one. A status that is heard
        late, since the host stood still, tells nothing of the time since it was taken.
        """
        not_before_ns = status.not_before_ns - offset_ns
        frozen = before is not None and abs(status.position_mm - before.position_mm) <= TOLERANCE_MM
        rests = frozen and not status.bits & apt.MOVING
        arrived = abs(status.position_mm - self.target_mm) <= TOLERANCE_MM
        homing = self.kind is Kind.HOME
        self._seen_moving |= not rests and before is not None
        if homing:
            self._seen_moving |= not status.bits & apt.HOMED
        settled = bool(status.bits & apt.SETTLED) or arrived or self.kind is Kind.STOP
        self._resting = self._resting + 1 if rests and settled else 0
        if self._meets_limit(status, arrived):
            return Outcome.MET_LIMIT
        if self._resting >= _READINGS_AT_REST and self._complete(status, arrived):
            return Outcome.ENDED
        if not_before_ns > self.deadline_ns:
            return Outcome.LATE
        if self.kind is Kind.STOP:
            return Outcome.GOING
        if not self._seen_moving and not_before_ns - self.begun_ns > BEGIN_NS:
            return Outcome.NOT_BEGUN
        wrong = bool(status.bits & apt.POSITION_ERROR)
        if not homing:
            wrong |= verdict is Verdict.BEHIND or (frozen and self._seen_moving and not arrived)
        if not wrong:
            self._wrong_since_ns = None
            return Outcome.GOING
        if self._wrong_since_ns is None:
            self._wrong_since_ns = status.latest_ns - offset_ns
        stuck_ns = not_before_ns - self._wrong_since_ns
        return Outcome.STUCK if stuck_ns >= STALL_NS else Outcome.GOING

    def _complete(self, status: Status, arrived: bool) -> bool:
        """Whether rest is the end: told so, or where it was to be."""
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
