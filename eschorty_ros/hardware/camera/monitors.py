"""Temperature, packet period and trigger input of the sensor, and the switch of its light meter.

Source: openeb 5.1.1 ``imx636_tz_device.cpp``. Unconfirmed on hardware.
"""

from __future__ import annotations

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.camera.registers import (
    Registers,
    Sleep,
    Write,
    await_bits,
    parse_sequence,
    run_sequence,
    update,
)

PACKET_PERIOD_US = (16, 65_520)

_PACKET_PERIOD = 0xB028
_PERIOD_MASK = 0xFFF0
_TRIGGER = Write(0x7004, 1 << 10, 1 << 10)

_ADC_CONTROL, _ADC_STATUS, _ADC_MISC = 0x4C, 0x50, 0x54
_ADC_SETUP = parse_sequence("4C[1]=1 4C[2]=2 54[2]=2 /100us/ 5C[2]=2 5C[1]=1 /100us/ 4C[2]=0")
_ADC_BEGIN = parse_sequence("4C[2]=2 54[1000]=1000 4C[4]=4")
_ADC_END = parse_sequence("4C[2]=0")
_ADC_DONE = 1 << 11
_ADC_TRIES = 5

_LIGHT_SETUP = parse_sequence("74[1]=1 74[2]=2 C[1]=1 /1ms/ C[2]=2 /1ms/ C[4]=4 /1ms/")
_OFF = parse_sequence("C[7]=0 74[3]=0 4C[3]=0 5C[3]=0")


def begin_monitors(registers: Registers, sleep: Sleep) -> None:
    """Switch temperature ADC and light meter on, after the sensor's initialisation."""
    run_sequence(registers, _ADC_SETUP + _LIGHT_SETUP, sleep)


def end_monitors(registers: Registers, sleep: Sleep) -> None:
    """Switch temperature ADC and light meter off."""
    run_sequence(registers, _OFF, sleep)


def read_temperature_c(registers: Registers, sleep: Sleep) -> float:
    """Return the temperature of the sensor (C).

    Raises ``DeviceError`` when the ADC does not finish.
    """
    run_sequence(registers, _ADC_BEGIN, sleep)
    value = await_bits(registers, _ADC_STATUS, _ADC_DONE, _ADC_TRIES, "the temperature ADC")
    run_sequence(registers, _ADC_END, sleep)
    return 0.190 * (value & 0x3FF) - 56.0


def set_packet_period(registers: Registers, period_us: int) -> int:
    """Set the time after which a packet leaves the sensor; returns the one in force (us).

    It is rounded down to a multiple of 16 us. Too short a period corrupts data.

    Raises ``ArgumentError`` outside 16 to 65520 us.
    """
    low, high = PACKET_PERIOD_US
    if not low <= period_us <= high:
        raise ArgumentError(f"mipi_frame_period is {period_us} us; choose {low} to {high}")
    registers.write(_PACKET_PERIOD, period_us & _PERIOD_MASK)
    return registers.read(_PACKET_PERIOD) & _PERIOD_MASK


def set_trigger_input(registers: Registers, enabled: bool) -> None:
    """Switch the trigger input (one channel, id 0)."""
    update(registers, _TRIGGER.address, _TRIGGER.mask, _TRIGGER.value if enabled else 0)
