"""Between ROS messages in SI units and the package's own nanoseconds and millimetres."""

from __future__ import annotations

from builtin_interfaces.msg import Time

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
