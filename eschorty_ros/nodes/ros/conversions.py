"""Conversions between messages in SI units and the package's nanoseconds and millimetres."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time

from eschorty_ros.core.clocks import PulseTrain
from eschorty_ros.core.modulation import Modulation

_NS_PER_S = 1_000_000_000


def stamp_from_ns(t_ns: int) -> Time:
    """Return the message stamp of an int64 time in nanoseconds; exact."""
    seconds, nanoseconds = divmod(int(t_ns), _NS_PER_S)
    return Time(sec=seconds, nanosec=nanoseconds)


def ns_from_stamp(stamp: Time) -> int:
    """Return the int64 nanoseconds of a message stamp; exact."""
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def mm_from_m(metres: float) -> float:
    """Return a length in metres in millimetres."""
    return metres * 1e3


def m_from_mm(millimetres: float) -> float:
    """Return a length in millimetres in metres."""
    return millimetres * 1e-3


def laser_settings(state: Any) -> tuple[Modulation, int | None, int | None]:
    """Return the modulation of a ``LaserState`` and its times.

    Returns
    -------
    modulation : Modulation
        Without ``on_edge_us``, which needs the camera's clock.
    epoch_ns : int or None
        ROS time of one rising edge, ``None`` when ``phase_epoch`` is zero, which means unknown.
    on_since_ns : int or None
        Since when the laser is on, ``None`` when it is off.

    Raises
    ------
    ArgumentError
        When frequency, duty or waveform is out of range.
    """
    modulation = Modulation(
        frequency_hz=float(state.frequency),
        duty=float(state.duty),
        waveform=str(state.waveform),
    )
    epoch_ns = ns_from_stamp(state.phase_epoch) or None
    on = state.output == state.OUTPUT_ON
    return modulation, epoch_ns, ns_from_stamp(state.output_since) if on else None


def pulse_train(trigger: Any) -> PulseTrain | None:
    """Return the stage's pulses that a ``PositionTrigger`` describes, ``None`` without pulses.

    Raises
    ------
    ArgumentError
        When a position is not finite or the interval is negative.
    """
    interval_mm = mm_from_m(float(trigger.interval))
    count = int(trigger.count)
    if interval_mm == 0.0 or count == 0:
        return None
    return PulseTrain(mm_from_m(float(trigger.first)), interval_mm, count)
