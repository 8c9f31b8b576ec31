"""Messages that the reconstruction receives, as the arguments of its pipeline."""

from __future__ import annotations

import struct

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.optics import Calibration, refuse_other_sensor
from eschorty_ros.live.packet_times import Packet
from eschorty_ros.nodes.ros.conversions import NS_PER_S

_PACKET_MAX_BYTES = 16_000_000
# A serialized message begins with its encoding; its numbers are aligned to what follows.
_LITTLE_ENDIAN, _BODY_AT = b"\0\1", 4
# Seconds, nanoseconds and the size of the frame's text; height and width; seq, time_base and the
# size of encoding.
_STAMP, _SENSOR = struct.Struct("<iII"), struct.Struct("<II")
_NUMBERS, _SIZE = struct.Struct("<QQI"), struct.Struct("<I")


def packet_from_message(message: bytes, source: bytes, calibration: Calibration) -> Packet:
    """Return the packet of a serialized ``EventPacket``, with a view of the events in it.

    To make an object of the message costs as much as some thousand events.

    Raises ``ArgumentError`` when it cannot be read, has another encoding or more bytes than a
    packet may have, and ``CalibrationError`` when it is of a smaller sensor.
    """
    if message[:2] != _LITTLE_ENDIAN:
        raise ArgumentError("a packet is not serialized in little-endian order; send it so")
    try:
        sec, nanosec, frame = _STAMP.unpack_from(message, _BODY_AT)
        at = _aligned(_BODY_AT + _STAMP.size + frame, 4)
        height, width = _SENSOR.unpack_from(message, at)
        at = _aligned(at + _SENSOR.size, 8)
        seq, _, text = _NUMBERS.unpack_from(message, at)
        at += _NUMBERS.size
        encoding = message[at : at + text].rstrip(b"\0").decode()
        # After is_bigendian.
        at = _aligned(at + text + 1, 4)
        (size,) = _SIZE.unpack_from(message, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise ArgumentError(f"a packet cannot be read: {error}") from error
    if encoding != "evt3":
        raise ArgumentError(f"encoding is {short(encoding)}; set the camera to evt3")
    refuse_other_sensor("a packet", width, height, calibration, larger=True)
    if size > _PACKET_MAX_BYTES:
        raise ArgumentError(
            f"a packet has {size} bytes; send {_PACKET_MAX_BYTES} at most, at a lower threshold"
        )
    events = memoryview(message)[at + _SIZE.size :][:size]
    if len(events) < size:
        raise ArgumentError(f"a packet of {size} bytes ends after {len(events)}")
    return Packet(seq, sec * NS_PER_S + nanosec, events, source)


def _aligned(at: int, size: int) -> int:
    """Return the first place from ``at`` on for a number of this size."""
    return at + (_BODY_AT - at) % size
