"""Conversions between messages in SI units and the package's nanoseconds and millimetres."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry

from eschorty_ros.core.base.numbers import number
from eschorty_ros.nodes.ros.frames import Frames

NS_PER_S = 1_000_000_000
_STAMP_MIN_NS, _STAMP_MAX_NS = -(NS_PER_S << 31), (NS_PER_S << 31) - 1


def stamp_from_ns(t_ns: int) -> Time:
    """Return the message stamp of a time in nanoseconds; exact from 1901 to 2038.

    A time outside, which no clock shows, becomes the nearest end.
    """
    seconds, nanoseconds = divmod(min(max(int(t_ns), _STAMP_MIN_NS), _STAMP_MAX_NS), NS_PER_S)
    return Time(sec=seconds, nanosec=nanoseconds)


def mm_from_m(metres: float) -> float:
    """Return a length in metres in millimetres."""
    return metres * 1e3


def m_from_mm(millimetres: float) -> float:
    """Return a length in millimetres in metres."""
    return millimetres * 1e-3


def odometry(names: Frames, t_ns: int, position_mm: float) -> Odometry:
    """Return the message of a stage's position, with a speed of zero."""
    message = Odometry(child_frame_id=names.stage)
    message.header.frame_id = names.base
    message.header.stamp = stamp_from_ns(t_ns)
    message.pose.pose.position.y = m_from_mm(position_mm)
    message.pose.pose.orientation.w = 1.0
    return message


def stage_position_mm(message: Any) -> float:
    """Return the stage's position in an ``Odometry``.

    Raises ``ArgumentError`` when the position is not within 1 km.
    """
    return mm_from_m(number("pose.pose.position.y", message.pose.pose.position.y, -1e3, 1e3))
