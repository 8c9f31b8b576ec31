"""The sensor's settings as the EVK4's registers hold them, in physical units."""

from __future__ import annotations

from dataclasses import dataclass

from eschorty_ros.emulation.evk4.registers import (
    BIAS_ADDRESSES,
    FACTORY_DACS,
    SENSOR_RESET,
    Registers,
)

_CONTROL, _MASKS_ON = 0x0004, 1 << 1
_COLUMN_MASKS = range(0x2000, 0x20A0, 4)
_ROW_MASKS = range(0x4000, 0x405C, 4)
_PIXEL_MASKS = range(0x9100, 0x9200, 4)
_TRIGGER, _PACKET_PERIOD = 0x7004, 0xB028
_ERC_PERIOD, _ERC_COUNT, _ERC_DROP, _ERC_ON = 0x6008, 0x600C, 0x6050, 0x6000
_AFK, _AFK_BAND, _STC, _STC_CUT, _TRAIL = 0xC000, 0xC008, 0xD000, 0xD004, 0xD008

SETTING_ADDRESSES = frozenset(
    [
        *BIAS_ADDRESSES.values(),
        _CONTROL,
        *_COLUMN_MASKS,
        *_ROW_MASKS,
        *_PIXEL_MASKS,
        *(_TRIGGER, _PACKET_PERIOD, _ERC_PERIOD, _ERC_COUNT, _ERC_DROP, _ERC_ON),
        *(_AFK, _AFK_BAND, _STC, _STC_CUT, _TRAIL),
        SENSOR_RESET,
    ]
)


@dataclass(frozen=True, slots=True)
class SensorSettings:
    """Settings of the sensor."""

    biases: tuple[tuple[str, int], ...]
    """DAC offsets from the camera's trim."""
    columns_off: frozenset[int]
    rows_off: frozenset[int]
    """Masked columns and rows."""
    pixels_off: frozenset[tuple[int, int]]
    """Masked pixels."""
    trigger_in: bool
    packet_period_us: int
    """Period of the sensor's packets."""
    event_rate: tuple[int, int] | None
    """Events that the event-rate control passes per period, and the period (us); None when off."""
    flicker_band_hz: tuple[float, float] | None
    """Band that the anti-flicker filter removes, None when off."""
    noise_filter: tuple[str, int] | None
    """``stc`` or ``trail`` with its threshold in us, None when off."""


def read_settings(registers: Registers) -> SensorSettings:
    """Return the settings in the registers."""
    return SensorSettings(
        biases=tuple(
            (name, (registers[address] & 0xFF) - FACTORY_DACS[name])
            for name, address in BIAS_ADDRESSES.items()
        ),
        columns_off=_lines(registers, _COLUMN_MASKS),
        rows_off=frozenset(row for row in _lines(registers, _ROW_MASKS) if row < 720),
        pixels_off=_pixels(registers),
        trigger_in=bool(registers[_TRIGGER] & 1 << 10),
        # Steps of 16 us; a period of 0 would never end a packet.
        packet_period_us=max(16, registers[_PACKET_PERIOD] & 0xFFF0),
        event_rate=_event_rate(registers),
        flicker_band_hz=_flicker_band(registers),
        noise_filter=_noise_filter(registers),
    )


def _lines(registers: Registers, addresses: range) -> frozenset[int]:
    if not registers[_CONTROL] & _MASKS_ON:
        return frozenset()
    return frozenset(
        32 * index + bit
        for index, address in enumerate(addresses)
        if registers[address]
        for bit in range(32)
        if registers[address] >> bit & 1
    )


def _pixels(registers: Registers) -> frozenset[tuple[int, int]]:
    words = (registers[address] for address in _PIXEL_MASKS)
    return frozenset((word & 0x7FF, word >> 16 & 0x7FF) for word in words if word >> 31)


def _event_rate(registers: Registers) -> tuple[int, int] | None:
    period_us = registers[_ERC_PERIOD] & 0x3FF
    if registers[_ERC_ON] & 3 != 1 or not registers[_ERC_DROP] & 1 or not period_us:
        return None
    return registers[_ERC_COUNT] & 0x3FFFFF, period_us


def _flicker_band(registers: Registers) -> tuple[float, float] | None:
    if registers[_AFK] & 5 != 1:
        return None
    shortest, longest = registers[_AFK_BAND] & 0xFF, registers[_AFK_BAND] >> 8 & 0xFF
    if not shortest or not longest:
        return None
    return 1e6 / (longest << 7), 1e6 / (shortest << 7)


def _noise_filter(registers: Registers) -> tuple[str, int] | None:
    if registers[_STC] & 5 != 1:
        return None
    for name, address in (("stc", _STC_CUT), ("trail", _TRAIL)):
        if registers[address] & 1:
            return name, registers[address] >> 1 & 0x7FFFF
    return None
