"""Messages of the stage as the device protocols' values."""

from __future__ import annotations

from eschorty_ros.hardware.protocols import PulseTrain
from eschorty_ros.msg import PositionTrigger
from eschorty_ros.nodes.conversions import m_from_mm, stamp_from_ns


def trigger_message(train: PulseTrain | None, stamp_ns: int) -> PositionTrigger:
    """``stage/trigger`` of the pulses the stage gives from ``stamp_ns`` on."""
    message = PositionTrigger()
    if train is not None:
        message.first = m_from_mm(train.first_mm)
        message.interval = m_from_mm(train.interval_mm)
        message.count = train.count
    message.header.stamp = stamp_from_ns(stamp_ns)
    return message
