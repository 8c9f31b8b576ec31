"""Messages that the reconstruction receives, as the arguments of its pipeline."""

from __future__ import annotations

from typing import Any

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import number, short
from eschorty_ros.core.clocks import PulseTrain
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.live.packet_times import Packet
from eschorty_ros.nodes.ros.border import check_text
from eschorty_ros.nodes.ros.conversions import mm_from_m, ns_from_stamp

_PACKET_MAX_BYTES = 16_000_000
_INTERVAL_M = 1e-6, 1.0


def laser_settings(state: Any) -> tuple[Modulation, int | None, int | None]:
    """Return the modulation of a ``LaserState``, its epoch and since when the laser is on, ns.

    The modulation is without ``on_edge_us``, which needs the camera's clock. The epoch is the ROS
    time of one rising edge, ``None`` when ``phase_epoch`` is zero, which means unknown; the last
    is ``None`` while the laser is off. Raises ``ArgumentError`` when frequency, duty or waveform
    is out of range.
    """
    check_text("waveform", state.waveform)
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

    Raises ``ArgumentError`` when a position is not finite or the interval is not one of a stage.
    """
    interval_mm = mm_from_m(float(trigger.interval))
    count = int(trigger.count)
    if interval_mm == 0.0 or count == 0:
        return None
    number("interval", trigger.interval, *_INTERVAL_M)
    return PulseTrain(mm_from_m(float(trigger.first)), interval_mm, count)


def packet_from_message(message: Any, source: bytes) -> Packet:
    """Return the packet of an ``EventPacket``.

    Raises ``ArgumentError`` when it has another encoding or more bytes than a packet may have.
    """
    size = len(message.events)
    if size > _PACKET_MAX_BYTES:
        raise ArgumentError(
            f"a packet has {size} bytes; send {_PACKET_MAX_BYTES} at most, at a lower threshold"
        )
    if message.encoding != "evt3":
        raise ArgumentError(f"encoding is {short(message.encoding)}; set the camera to evt3")
    return Packet(message.seq, ns_from_stamp(message.header.stamp), message.events, source)
