"""What a generator was asked, what it reads back, and how that differs; no ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.protocols import LaserOutput, LaserReadback

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
