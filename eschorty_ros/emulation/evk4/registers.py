"""The register file of an IMX636 in an EVK4: reset values, and the few registers that act.

All others are memory and read back the written value. Reset values are those that the public
drivers rely on; the rest reads 0. *Unconfirmed on hardware.*
"""

from __future__ import annotations

_CHIP_ID = 0xA0401806
FACTORY_DACS = {
    "bias_fo": 0x53,
    "bias_hpf": 0x00,
    "bias_diff_on": 0x66,
    "bias_diff": 0x4D,
    "bias_diff_off": 0x49,
    "bias_refr": 0x14,
}
"""A typical trim."""
BIAS_ADDRESSES = {
    "bias_fo": 0x1004,
    "bias_hpf": 0x100C,
    "bias_diff_on": 0x1010,
    "bias_diff": 0x1014,
    "bias_diff_off": 0x1018,
    "bias_refr": 0x1020,
}
_BIAS_WORD = 0x11A10000

_RESET = {
    0x0004: 0xF0005042,
    0x0014: _CHIP_ID,
    0x002C: 0x0022C324,
    0x003C: 0x02CF04FF,
    0x6000: 0x00155400,
    0x602C: 0x00000002,
    0x7004: 0x0000C5FF,
    0x9000: 0x00000200,
    0x9008: 0x00000644,
    0x9014: 0x02CF04FF,
    0xB028: 0x00000FA0,
    0xC000: 0x5,
    0xC0C4: 0x4,
    0xD000: 0x5,
}

_ADC_CONTROL, _ADC_STATUS, _ADC_MISC, _TEMPERATURE_CONTROL = 0x4C, 0x50, 0x54, 0x5C
_ANTI_FLICKER_FLAGS, _TRAIL_FLAGS = 0xC0C4, 0xD0C4
SENSOR_RESET = 0x400004


class Registers:
    """Addresses (multiples of 4) to 32-bit values.

    Public attributes:
    - ``temperature_c``: Temperature that the sensor reports.
    """

    def __init__(self) -> None:
        self.temperature_c = 35.0
        self._values: dict[int, int] = {}
        self._temperature_ready = False
        self.reset()

    def reset(self) -> None:
        """Set the values after power-up or a sensor reset."""
        self._values = dict(_RESET)
        for name, address in BIAS_ADDRESSES.items():
            self._values[address] = _BIAS_WORD | FACTORY_DACS[name]

    def __getitem__(self, address: int) -> int:
        return self._values.get(address, 0)

    def read(self, address: int) -> int:
        """Read over the bus: the temperature is polled by reading."""
        return self._temperature() if address == _ADC_STATUS else self[address]

    def write(self, address: int, value: int) -> None:
        """Write over the bus."""
        if address == SENSOR_RESET and self[address] and not value:
            self.reset()
        elif address in (_ANTI_FLICKER_FLAGS, _TRAIL_FLAGS):
            value = self._flags(address, value)
        elif address == _ADC_CONTROL:
            self._temperature_ready = False
        self._values[address] = value

    def _flags(self, address: int, value: int) -> int:
        """Return the new flags: bit 0 requests bit 2 (ready), a 1 written to bit 2 clears it."""
        return (value & ~4) | (4 if value & 1 else self[address] & 4 & ~value)

    def _temperature(self) -> int:
        running = self[_ADC_CONTROL] & 0b110 == 0b110 and self[_TEMPERATURE_CONTROL] & 0b11 == 0b11
        if not (running and self[_ADC_MISC] & 1 << 12):
            return 0
        if not self._temperature_ready:
            # The conversion takes longer than the first poll.
            self._temperature_ready = True
            return 0
        return 1 << 11 | round((self.temperature_c + 56.0) / 0.190) & 0x3FF
