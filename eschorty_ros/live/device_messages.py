"""Messages of laser and stage, live or from a bag, as the arguments of a packet stream."""

from __future__ import annotations

from typing import Any, NamedTuple

from eschorty_ros.core.base.numbers import number
from eschorty_ros.core.clocks import PulseTrain
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ, Modulation

MM_PER_M = 1e3
_OUTPUT_ON = 1
_INTERVAL_M = 1e-6, 1.0


def ns_from_stamp(time: Any) -> int:
    """Return the int64 nanoseconds of a ROS time; exact."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


class LaserSettings(NamedTuple):
    """Modulation of the laser, the ROS time of one rising edge and since when the laser is on.

    The modulation is without ``on_edge_us``, which needs the camera's clock. ``epoch_ns`` is
    ``None`` while it is unknown, ``on_since_ns`` while the laser is off.
    """

    modulation: Modulation
    epoch_ns: int | None
    on_since_ns: int | None


def laser_settings(state: Any) -> LaserSettings:
    """Return the settings of a ``LaserState``; a ``phase_epoch`` of zero means unknown.

    Raises ``ArgumentError`` when frequency, duty or waveform is out of range.
    """
    frequency_hz = number("frequency", state.frequency, FREQUENCY_MIN_HZ, FREQUENCY_MAX_HZ)
    modulation = Modulation(frequency_hz, float(state.duty), str(state.waveform))
    on = state.output == _OUTPUT_ON
    return LaserSettings(
        modulation,
        epoch_ns=ns_from_stamp(state.phase_epoch) or None,
        on_since_ns=ns_from_stamp(state.output_since) if on else None,
    )


def pulse_train(trigger: Any) -> PulseTrain | None:
    """Return the stage's pulses that a ``PositionTrigger`` describes, ``None`` without pulses.

    Raises ``ArgumentError`` when a position is not finite or the interval is not one of a stage.
    """
    if not trigger.interval or not trigger.count:
        return None
    interval_mm = number("interval", trigger.interval, *_INTERVAL_M) * MM_PER_M
    return PulseTrain(float(trigger.first) * MM_PER_M, interval_mm, int(trigger.count))
