"""Anti-flicker filter: removes light that flickers at 50 to 520 Hz, or keeps only that.

Source: openeb 5.1.1 ``antiflicker_filter.cpp``. The band-stop erases a laser modulated within the
band; modulation at kHz passes. Unconfirmed on hardware.
"""

from __future__ import annotations

from dataclasses import dataclass

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.camera.registers import Registers, await_bits, update

ANTI_FLICKER_HZ = (50, 520)

_PIPELINE, _INITIALISATION, _INVALIDATION = 0xC000, 0xC0C4, 0xC0C0
_PARAMETERS, _PERIOD = 0xC004, 0xC008
_BYPASS, _ON = 0b101, 0b001
_READY = 1 << 2
_TRIES = 3
_STOP_COUNT, _START_COUNT = 4, 6
_HALF_DUTY = 8
"""Duty cycle of the light in sixteenths."""


@dataclass(frozen=True, slots=True)
class AntiFlicker:
    """Band of the filter.

    Raises ``ArgumentError`` for band edges outside the range.
    """

    low_hz: int = 50
    high_hz: int = 520
    """Band edges, 50 to 520 Hz."""
    band_pass: bool = False
    """Keep only light that flickers in the band."""

    def __post_init__(self) -> None:
        low, high = ANTI_FLICKER_HZ
        if not low <= self.low_hz <= self.high_hz <= high:
            raise ArgumentError(
                f"anti-flicker band is {self.low_hz} to {self.high_hz} Hz; "
                f"choose {low} <= low <= high <= {high}"
            )

    def erases(self, frequency_hz: float) -> bool:
        """Return whether the filter removes light modulated at ``frequency_hz``."""
        inside = self.low_hz <= frequency_hz <= self.high_hz
        return inside != self.band_pass


def set_anti_flicker(registers: Registers, band: AntiFlicker | None) -> None:
    """Switch the filter on with ``band``, off with ``None``.

    Raises ``DeviceError`` when the filter's memory does not become ready.
    """
    registers.write(_PIPELINE, _BYPASS)
    if band is None:
        return
    await_bits(registers, _INITIALISATION, _READY, _TRIES, "the anti-flicker filter")
    update(registers, _INVALIDATION, 0xFFF, 1630)
    period = _period(band.high_hz) | _period(band.low_hz) << 8 | _HALF_DUTY << 16
    update(registers, _PERIOD, 0xF_FFFF, period)
    counts = _STOP_COUNT | _START_COUNT << 3 | int(band.band_pass) << 6
    update(registers, _PARAMETERS, 0x7F, counts)
    registers.write(_PIPELINE, _ON)


def _period(frequency_hz: int) -> int:
    """Return the period in units of 128 us."""
    return 1_000_000 // frequency_hz >> 7
