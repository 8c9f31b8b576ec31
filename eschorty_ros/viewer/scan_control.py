"""When a page may start a scan, and when the scan that it started is cancelled."""

from __future__ import annotations

import hmac
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import integer, number
from eschorty_ros.live.sweep_coverage import PASSES_MAX

ABANDONED_S = 5.0
_CODE_BYTES = 4
_TRIES = 5


class ScanValues(NamedTuple):
    """A scan as the page requests it: mm, mm/s, Hz; duty 0 keeps the laser's.

    ``record`` is a folder of the reconstruction's computer; without one, its own parameter holds.
    """

    start_mm: float = 10.0
    stop_mm: float = 60.0
    speed_mm_s: float = 50.0
    frequency_hz: float = 70.0
    duty: float = 0.0
    passes: int = 1
    record: str = ""

    def __str__(self) -> str:
        duty = f", duty {self.duty:g}" if self.duty else ""
        record = f", recorded into {self.record}" if self.record else ""
        return (
            f"{self.start_mm:g} to {self.stop_mm:g} mm at {self.speed_mm_s:g} mm/s, "
            f"{self.frequency_hz:g} Hz{duty}, passes: {self.passes}{record}"
        )


@dataclass(frozen=True)
class Conditions:
    """State of the instrument as received; the defaults are those before the first message."""

    scanner: bool = False
    scanning: bool = False
    laser: bool = False
    interlock_open: bool = True

    def refusal(self) -> str:
        """Return why no scan may begin, ``""`` when it may."""
        if not self.scanner:
            return "no scanner is there"
        if not self.laser:
            return "the laser node does not report"
        if self.interlock_open:
            return "the laser's interlock is open"
        return "a scan is running; wait for its end or cancel it" if self.scanning else ""


class ScanControl:
    """Decides over requests of a page; light needs the switch and the code of the terminal.

    Other programs that reach the server do not have the code.

    - ``allowed``: Whether scans may be started at all.
    - ``clock``: Returns monotonic seconds.
    """

    def __init__(self, allowed: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self.allowed = allowed
        self.code = secrets.token_hex(_CODE_BYTES) if allowed else ""
        self._clock = clock
        self._tries = _TRIES
        self._ours = False
        self._seen_s = clock()

    def start(self, values: ScanValues, code: str, conditions: Conditions) -> ScanValues:
        """Return the values of a scan that may begin.

        Raises ``ArgumentError`` when it may not, with the reason.
        """
        if not self.allowed:
            raise ArgumentError("this page may not start scans; start it with --allow-scan")
        if not self._tries:
            raise ArgumentError("the code was wrong too often; start the viewer again")
        if not hmac.compare_digest(code.strip().encode(), self.code.encode()):
            self._tries -= 1
            raise ArgumentError("the code is not the one on the viewer's terminal; enter that one")
        self._tries = _TRIES
        if refusal := conditions.refusal():
            raise ArgumentError(refusal)
        for name, value in values._asdict().items():
            if not isinstance(value, str):
                number(name, value)
        integer("passes", values.passes, 1, PASSES_MAX)
        if values.start_mm == values.stop_mm:
            raise ArgumentError("start and stop are the same position; give a distance")
        self._ours, self._seen_s = True, self._clock()
        return values

    @property
    def under_way(self) -> bool:
        """Return whether a scan of this page has begun and not ended."""
        return self._ours

    def ended(self) -> None:
        """Take note that the scan has ended."""
        self._ours = False

    def abandoned(self, pages: int) -> bool:
        """Return whether a scan of this page is under way and no page has been there for 5 s."""
        if pages:
            self._seen_s = self._clock()
        return self._ours and self._clock() - self._seen_s > ABANDONED_S
