"""The requested state of the laser, its read-back, and the difference of the two."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserOutput, LaserReadback

FREQUENCY_TOLERANCE = 1e-4
DUTY_TOLERANCE = 2e-3
_UNKNOWN = "laser state unknown: "


@dataclass(frozen=True, slots=True)
class LaserStatus:
    """The output that was requested and why, and what the generator reads back."""

    requested: LaserOutput
    readback: LaserReadback
    reason: str


class LaserRecord:
    """The requested state of a generator and its last read-back; without a lock.

    Public attributes:
    - ``modulation``: The one that was requested.
    - ``readback``: The newest, ``None`` before the first.
    - ``reason``: Why the output was requested so.
    - ``unknown``: Why the state of the output is unknown, empty when it is known.
    """

    def __init__(self) -> None:
        self.requested = LaserOutput.OFF
        self.modulation: Modulation | None = None
        self.readback: LaserReadback | None = None
        self.reason = "off at start"
        self.unknown = ""
        self._warned: set[str] = set()

    @property
    def status(self) -> LaserStatus | None:
        """Return request, read-back and reason, ``None`` before the first read-back."""
        readback = self.readback
        if readback is None:
            return None
        return LaserStatus(self.requested, readback, self.unknown or self.reason)

    def receive(self, readback: LaserReadback) -> list[str]:
        """Take a read-back; returns those of its warnings that are new."""
        self.readback = readback
        self.unknown = ""
        if readback.output is LaserOutput.UNKNOWN:
            self.unknown = _headed(readback.reason or "the generator does not report it")
        fresh = [text for text in dict.fromkeys(readback.warnings) if text not in self._warned]
        self._warned.update(fresh)
        return fresh

    def assume_off(self) -> LaserReadback | None:
        """Return the read-back to take when the generator has confirmed only that it is off."""
        if self.readback is None:
            return None
        return replace(self.readback, output=LaserOutput.OFF, output_since_ns=time.time_ns())

    def lose(self, error: Exception) -> None:
        """Note that the output may be on or off."""
        self.unknown = _headed(str(error))
        if self.readback is not None:
            self.readback = replace(self.readback, output=LaserOutput.UNKNOWN)

    def difference(self, readback: LaserReadback) -> str:
        """Return how a read-back differs from what was requested, ``""`` when it does not."""
        return self._output_difference(readback) or self._modulation_difference(readback)

    def must_disable(self, readback: LaserReadback) -> str:
        """Return why the newest read-back demands that the output is disabled, ``""`` if not."""
        if self.requested is LaserOutput.ON:
            return self.difference(readback)
        return self._output_difference(readback) or self.unknown

    def _output_difference(self, readback: LaserReadback) -> str:
        if readback.output in (self.requested, LaserOutput.UNKNOWN):
            return ""
        why = f" ({readback.reason})" if readback.reason else ""
        return f"output reads back {readback.output.name}, requested {self.requested.name}{why}"

    def _modulation_difference(self, readback: LaserReadback) -> str:
        request, found = self.modulation, readback.modulation
        if request is None:
            return ""
        if not math.isclose(found.frequency_hz, request.frequency_hz, rel_tol=FREQUENCY_TOLERANCE):
            return (
                f"frequency reads back {found.frequency_hz:g} Hz, "
                f"requested {request.frequency_hz:g} Hz"
            )
        if abs(found.duty - request.duty) > DUTY_TOLERANCE:
            return f"duty reads back {found.duty:g}, requested {request.duty:g}"
        if found.waveform != request.waveform:
            return f"waveform reads back {found.waveform}, requested {request.waveform}"
        return ""


def _headed(text: str) -> str:
    return text if text.startswith(_UNKNOWN) else _UNKNOWN + text
