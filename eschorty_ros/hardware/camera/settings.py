"""The camera's settings, and writing them to the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from eschorty_ros.hardware.camera.anti_flicker import AntiFlicker, set_anti_flicker
from eschorty_ros.hardware.camera.biases import BiasBank, check_offset
from eschorty_ros.hardware.camera.event_rate import set_event_rate
from eschorty_ros.hardware.camera.event_trail import clear_event_trail, set_event_trail
from eschorty_ros.hardware.camera.monitors import set_packet_period, set_trigger_input
from eschorty_ros.hardware.camera.pixel_selection import Window, set_hot_pixels, set_windows
from eschorty_ros.hardware.camera.registers import Registers


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings of an EVK4; the defaults leave the sensor as its initialisation made it."""

    biases: Mapping[str, int] = field(default_factory=dict)
    """Offsets from the factory trim; biases not named keep it."""
    wide_biases: bool = False
    """Allow the wide ranges."""
    packet_period_us: int | None = None
    """Period of the sensor's packets, the latency of the stream; ``None`` leaves 4000 us."""
    erc_rate: int | None = None
    """Events/s beyond which the sensor drops some; ``None`` switches the control off."""
    anti_flicker: AntiFlicker | None = None
    trail_filter: str = ""
    """``""`` (off) or a type of :mod:`~eschorty_ros.hardware.camera.event_trail`."""
    trail_threshold_us: int = 10_000
    windows: tuple[Window, ...] = ()
    """Regions of interest: first column, first row, width, height."""
    hot_pixels: tuple[tuple[int, int], ...] = ()
    """Columns and rows to mask, at most 64."""
    trigger_input: bool = False

    def __post_init__(self) -> None:
        for name, offset in self.biases.items():
            check_offset(name, offset, self.wide_biases)


def apply_settings(
    registers: Registers, biases: BiasBank, settings: CameraSettings
) -> dict[str, float]:
    """Write every setting; returns the values read back, by name with unit.

    Raises ``ArgumentError`` for a value outside its range. Raises ``DeviceError`` when the camera
    does not answer or reads back another value.
    """
    for name, offset in settings.biases.items():
        biases.write(name, offset)
    applied: dict[str, float] = dict(biases.read())
    if settings.packet_period_us is not None:
        applied["packet_period_us"] = set_packet_period(registers, settings.packet_period_us)
    applied["erc_rate_hz"] = set_event_rate(registers, settings.erc_rate)
    set_anti_flicker(registers, settings.anti_flicker)
    if settings.trail_filter:
        applied["trail_threshold_us"] = set_event_trail(
            registers, settings.trail_filter, settings.trail_threshold_us
        )
    else:
        clear_event_trail(registers)
    set_windows(registers, settings.windows)
    set_hot_pixels(registers, settings.hot_pixels)
    set_trigger_input(registers, settings.trigger_input)
    return applied
