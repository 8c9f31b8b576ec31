"""Between ROS messages in SI units and the package's own nanoseconds and millimetres."""

from __future__ import annotations

from builtin_interfaces.msg import Time

from eschorty_ros.core.clocks import PulseTrain
from eschorty_ros.core.modulation import Modulation

_NS_PER_S = 1_000_000_000


def stamp_from_ns(t_ns: int) -> Time:
    """Message stamp of an int64 time in nanoseconds; exact."""
    seconds, nanoseconds = divmod(int(t_ns), _NS_PER_S)
    return Time(sec=seconds, nanosec=nanoseconds)


def ns_from_stamp(stamp: Time) -> int:
    """Int64 nanoseconds of a message stamp; exact."""
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def mm_from_m(metres: float) -> float:
    """Millimetres of a length in metres."""
    return metres * 1e3


def m_from_mm(millimetres: float) -> float:
    """Metres of a length in millimetres."""
    return millimetres * 1e-3


def modulation_from_laser_state(state: object) -> tuple[Modulation, int | None]:
    """Modulation a ``LaserState`` reports, and the ROS time of one rising edge.

    Returns
    -------
    modulation : Modulation
        Without ``on_edge_us``: that needs the camera's clock.
    epoch_ns : int or None
        ``None`` when the message's ``phase_epoch`` is zero, which means unknown.

    Raises
    ------
    ArgumentError
        When the message holds a frequency, duty or waveform out of range.
    """
    modulation = Modulation(
        frequency_hz=float(state.frequency),  # type: ignore[attr-defined]
        duty=float(state.duty),  # type: ignore[attr-defined]
        waveform=str(state.waveform),  # type: ignore[attr-defined]
    )
    epoch_ns = ns_from_stamp(state.phase_epoch)  # type: ignore[attr-defined]
    return modulation, epoch_ns or None


def laser_settings(state: object) -> tuple[Modulation, int | None, int | None]:
    """Add to ``modulation_from_laser_state`` since when the laser is on, ``None`` when off."""
    modulation, epoch_ns = modulation_from_laser_state(state)
    lit = state.output == state.OUTPUT_ON  # type: ignore[attr-defined]
    since_ns = ns_from_stamp(state.output_since) if lit else None  # type: ignore[attr-defined]
    return modulation, epoch_ns, since_ns


def pulse_train(trigger: object) -> tuple[PulseTrain | None]:
    """Where a ``PositionTrigger`` says that the stage gives pulses, ``None`` when nowhere.

    Raises
    ------
    ArgumentError
        When the message holds a position that is not finite or a negative interval.
    """
    interval_mm = mm_from_m(float(trigger.interval))  # type: ignore[attr-defined]
    count = int(trigger.count)  # type: ignore[attr-defined]
    if interval_mm == 0.0 or count == 0:
        return (None,)
    return (PulseTrain(mm_from_m(float(trigger.first)), interval_mm, count),)  # type: ignore[attr-defined]
