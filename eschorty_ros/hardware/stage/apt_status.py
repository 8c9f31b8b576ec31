"""Which status messages to believe, and what they say about the axis.

A frame has no checksum: one flipped bit is a wrong position. One odd message is therefore asked
for again, and only what two say is so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto

from eschorty_ros.hardware.stage import apt_messages as apt

# An answer that belongs to no known request may be so late.
LATE_NS = 500_000_000
REST_MARGIN_MM = 0.02
MOVE_MARGIN_MM = 1.0
_CRITICAL = apt.HOMED | apt.ENABLED | apt.FAULTS | apt.LIMITS


class Verdict(Enum):
    """What to do with a status message."""

    BELIEVE = auto()
    ASK_AGAIN = auto()
    BEHIND = auto()
    JUMPED = auto()
    CONTRADICTORY = auto()


@dataclass(frozen=True, slots=True)
class Status:
    """One status message: where, its bits, and when it can have been taken (ns)."""

    position_mm: float
    bits: int
    earliest_ns: int | None
    latest_ns: int

    @property
    def not_before_ns(self) -> int:
        """Time before which it was not taken, whether its request is known or not."""
        return self.latest_ns - LATE_NS if self.earliest_ns is None else self.earliest_ns

    @property
    def critical(self) -> int:
        """Bits that must not change by themselves."""
        return self.bits & _CRITICAL


class Judge:
    """Plausibility of status messages.

    Attributes
    ----------
    rejected : int
        Messages that were not believed.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self._last: Status | None = None
        self._odd: Status | None = None

    def forget(self) -> None:
        """Take the next message as it comes."""
        self._last = self._odd = None

    def judge(
        self, status: Status, expected_mm: tuple[float, float] | None, speed_mm_s: float
    ) -> Verdict:
        """Judge one message.

        Parameters
        ----------
        status : Status
        expected_mm : tuple of float or None
            Where the ordered motion can be; ``None`` when nobody knows.
        speed_mm_s : float
            Fastest the carriage may move now; 0 at rest.
        """
        last, odd = self._last, self._odd
        if last is None:
            return self._believe(status)
        margin_mm = MOVE_MARGIN_MM if speed_mm_s else REST_MARGIN_MM
        reach_mm = margin_mm + _reach_mm(last, status, speed_mm_s)
        continuous = abs(status.position_mm - last.position_mm) <= reach_mm
        low, high = expected_mm or (-math.inf, math.inf)
        slack_mm = margin_mm + 6e-3 * speed_mm_s
        on_its_way = low - slack_mm <= status.position_mm <= high + slack_mm
        if continuous and on_its_way and status.critical == last.critical:
            return self._believe(status)
        if odd is None:
            self._odd = status
            self.rejected += 1
            return Verdict.ASK_AGAIN
        near = abs(status.position_mm - odd.position_mm) <= (
            margin_mm + _reach_mm(odd, status, speed_mm_s)
        )
        if not near or status.critical != odd.critical:
            self.rejected += 1
            return Verdict.CONTRADICTORY
        self._believe(status)
        if not continuous:
            return Verdict.JUMPED
        return Verdict.BELIEVE if on_its_way else Verdict.BEHIND

    def _believe(self, status: Status) -> Verdict:
        self._last, self._odd = status, None
        return Verdict.BELIEVE


def _reach_mm(first: Status, second: Status, speed_mm_s: float) -> float:
    """How far the carriage gets between two messages."""
    begin_ns = first.not_before_ns
    return 1.2 * speed_mm_s * max(second.latest_ns - begin_ns, 0) * 1e-9
