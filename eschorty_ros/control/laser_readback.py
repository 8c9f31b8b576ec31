"""What a generator was asked, what it reads back, and how that differs; no ROS."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserOutput, LaserReadback

FREQUENCY_TOLERANCE = 1e-4
DUTY_TOLERANCE = 2e-3


@dataclass(frozen=True, slots=True)
class LaserSnapshot:
    """What was asked, what was read back, and why."""

    requested: LaserOutput
    told: LaserReadback
    reason: str


def wrong_output(told: LaserReadback, requested: LaserOutput) -> str:
    """How the output differs from what was requested, ``""`` when it does not or is unknown."""
    if told.output in (requested, LaserOutput.UNKNOWN):
        return ""
    why = f" ({told.reason})" if told.reason else ""
    return f"output reads back {told.output.name}, asked {requested.name}{why}"


def wrong_waveform(told: LaserReadback, asked: Modulation | None) -> str:
    """How the modulation differs from what was asked, ``""`` when it does not."""
    if asked is None:
        return ""
    now = told.modulation
    if not math.isclose(now.frequency_hz, asked.frequency_hz, rel_tol=FREQUENCY_TOLERANCE):
        return f"frequency reads back {now.frequency_hz:g} Hz, asked {asked.frequency_hz:g} Hz"
    if abs(now.duty - asked.duty) > DUTY_TOLERANCE:
        return f"duty reads back {now.duty:g}, asked {asked.duty:g}"
    if now.waveform != asked.waveform:
        return f"waveform reads back {now.waveform}, asked {asked.waveform}"
    return ""


def unknown_text(text: str) -> str:
    """Head a line with what it means, unless it says so itself."""
    heading = "laser state unknown: "
    return text if text.startswith(heading) else heading + text


class LaserRecord:
    """What was asked of a generator, and what is known of it; takes no lock.

    Attributes
    ----------
    requested : LaserOutput
    asked : Modulation or None
    told : LaserReadback or None
        The newest read-back, ``None`` before the first.
    reason : str
        Why the output was requested so.
    unknown : str
        Why the state of the output is unknown, empty when it is known.
    """

    def __init__(self) -> None:
        self.requested = LaserOutput.OFF
        self.asked: Modulation | None = None
        self.told: LaserReadback | None = None
        self.reason = "off at start"
        self.unknown = ""
        self._warned: set[str] = set()

    @property
    def snapshot(self) -> LaserSnapshot | None:
        """What is known now, ``None`` before the first read-back."""
        told = self.told
        return None if told is None else LaserSnapshot(self.requested, told, self.reason)

    def calls_for_darkness(self, told: LaserReadback) -> str:
        """Why ``told``, just heard, is a reason to switch off, ``""`` when it is none."""
        if self.requested is LaserOutput.ON:
            return self.difference(told)
        return wrong_output(told, self.requested) or self.unknown

    def hear(self, told: LaserReadback) -> list[str]:
        """Note what the generator says; its warnings that are new."""
        self.told = told
        self.unknown = ""
        if told.output is LaserOutput.UNKNOWN:
            self.unknown = unknown_text(told.reason or "the generator does not say")
        fresh = [text for text in dict.fromkeys(told.warnings) if text not in self._warned]
        self._warned.update(fresh)
        return fresh

    def off_unread(self) -> LaserReadback | None:
        """Read-back to assume when the generator has confirmed no more than that it is off."""
        if self.told is None:
            return None
        return replace(self.told, output=LaserOutput.OFF, output_since_ns=time.time_ns())

    def lose(self, error: Exception) -> None:
        """Note that the output may be anything."""
        self.unknown = unknown_text(str(error))
        if self.told is not None:
            self.told = replace(self.told, output=LaserOutput.UNKNOWN)

    def difference(self, told: LaserReadback) -> str:
        """How ``told`` differs from what was asked, ``""`` when it does not."""
        return wrong_output(told, self.requested) or wrong_waveform(told, self.asked)
