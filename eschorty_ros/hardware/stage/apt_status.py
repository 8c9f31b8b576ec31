"""Plausibility checks of status messages.

A frame has no checksum: one flipped bit is a wrong position. An implausible message is therefore
requested again, and only what two messages agree on counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto

from eschorty_ros.hardware.stage import apt_messages as apt

# The longest delay of an answer whose request is unknown.
LATE_NS = 500_000_000
_REST_MARGIN_MM = 0.02
_MOVE_MARGIN_MM = 1.0
_CRITICAL = apt.HOMED | apt.ENABLED | apt.FAULTS | apt.COMMAND_ERROR | apt.LIMITS


class Plausibility(Enum):
    """Plausibility of a status message; all but ``REPEAT`` and ``CONTRADICTORY`` are used."""

    NORMAL = auto()
    REPEAT = auto()
    """Implausible: request another one."""
    OFF_PATH = auto()
    """Two messages agree that the carriage is not where its motion should be."""
    JUMPED = auto()
    """Two messages agree on a position that the carriage cannot have reached."""
    CONTRADICTORY = auto()
    """Two implausible messages disagree."""


@dataclass(frozen=True, slots=True)
class Status:
    """One status message: position, bits, and the interval in which it was taken (ns)."""

    position_mm: float
    bits: int
    earliest_ns: int | None
    latest_ns: int

    @property
    def not_before_ns(self) -> int:
        """Return the earliest time it can have been taken at, its request known or not."""
        return self.latest_ns - LATE_NS if self.earliest_ns is None else self.earliest_ns

    @property
    def critical(self) -> int:
        """Return the bits that must not change by themselves."""
        return self.bits & _CRITICAL


class StatusChecks:
    """Compares each status message with the one before and with the expected motion.

    Public attributes:
    - ``rejected``: Messages that were not used.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self._last: Status | None = None
        self._implausible: Status | None = None

    def reset(self) -> None:
        """Accept the next message without a check."""
        self._last = self._implausible = None

    def check(
        self, status: Status, expected_mm: tuple[float, float] | None, speed_mm_s: float
    ) -> Plausibility:
        """Return the plausibility of one message.

        - ``expected_mm``: Where the ordered motion can be; ``None`` when unknown.
        - ``speed_mm_s``: Fastest the carriage may move now; 0 at rest.
        """
        last, implausible = self._last, self._implausible
        if last is None:
            return self._use(status)
        margin_mm = _MOVE_MARGIN_MM if speed_mm_s else _REST_MARGIN_MM
        continuous = _reachable(last, status, speed_mm_s, margin_mm)
        low, high = expected_mm or (-math.inf, math.inf)
        slack_mm = margin_mm + 6e-3 * speed_mm_s
        on_path = low - slack_mm <= status.position_mm <= high + slack_mm
        if continuous and on_path and status.critical == last.critical:
            return self._use(status)
        if implausible is None:
            self._implausible = status
            self.rejected += 1
            return Plausibility.REPEAT
        if (
            not _reachable(implausible, status, speed_mm_s, margin_mm)
            or status.critical != implausible.critical
        ):
            self.rejected += 1
            return Plausibility.CONTRADICTORY
        self._use(status)
        if not continuous:
            return Plausibility.JUMPED
        return Plausibility.NORMAL if on_path else Plausibility.OFF_PATH

    def _use(self, status: Status) -> Plausibility:
        self._last, self._implausible = status, None
        return Plausibility.NORMAL


def _reachable(first: Status, second: Status, speed_mm_s: float, margin_mm: float) -> bool:
    """Return whether the carriage can get from one message's position to the other's."""
    between_s = max(second.latest_ns - first.not_before_ns, 0) * 1e-9
    distance_mm = abs(second.position_mm - first.position_mm)
    return distance_mm <= margin_mm + 1.2 * speed_mm_s * between_s
