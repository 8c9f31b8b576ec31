"""Pixel biases as offsets from the factory trim, and ``.bias`` files.

Source: openeb 5.1.1 ``imx636_ll_biases.cpp``, ``imx636_bias_settings*.h``. A bias register holds
an 8-bit DAC value below its enable bits; the factory's trim is what it reads after the sensor's
initialisation. Unconfirmed on hardware.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from eschorty_ros.core.base.errors import ArgumentError, DeviceError, FormatError
from eschorty_ros.core.base.files import atomic_write, read_regular_file
from eschorty_ros.core.base.numbers import short
from eschorty_ros.hardware.camera.registers import Registers

ENABLED = 0x11A1_0000
_DAC = 0xFF
_BYTES_MAX = 65_536


@dataclass(frozen=True, slots=True)
class BiasInfo:
    """Register address of a bias and its ranges of offsets (inclusive)."""

    address: int
    normal: tuple[int, int]
    wide: tuple[int, int]
    acts_on: str


BIASES: Mapping[str, BiasInfo] = {
    "bias_diff_on": BiasInfo(0x1010, (-85, 140), (-150, 200), "ON threshold"),
    "bias_diff_off": BiasInfo(0x1018, (-35, 190), (-150, 200), "OFF threshold"),
    "bias_fo": BiasInfo(0x1004, (-35, 55), (-150, 200), "pixel low-pass: bandwidth, latency"),
    "bias_hpf": BiasInfo(0x100C, (0, 120), (0, 255), "high-pass: removes slow changes"),
    "bias_refr": BiasInfo(0x1020, (-20, 235), (-50, 255), "refractory (dead) time"),
}
"""The biases users set. ``bias_diff``, the common reference, stays as it is."""


class BiasBank:
    """Biases of an initialised sensor.

    Public attributes:
    - ``factory``: DAC values read before anything was written.

    Raises ``DeviceError`` when the camera does not answer.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self.factory = {name: registers.read(info.address) & _DAC for name, info in BIASES.items()}

    def read(self) -> dict[str, int]:
        """Return the offsets in the camera."""
        return {
            name: (self._registers.read(info.address) & _DAC) - self.factory[name]
            for name, info in BIASES.items()
        }

    def write(self, name: str, offset: int) -> int:
        """Set one bias to an offset that ``CameraSettings`` accept; returns the one read back.

        The DAC is clamped to 0..255, so the offset read back may be nearer to 0.

        Raises ``DeviceError`` when the camera reads back another value than was written.
        """
        address = BIASES[name].address
        dac = min(max(self.factory[name] + offset, 0), _DAC)
        self._registers.write(address, ENABLED | dac)
        kept = self._registers.read(address) & _DAC
        if kept != dac:
            raise DeviceError(
                f"camera: {name} was set to DAC {dac} and reads back {kept}; "
                "close and open the camera, or power-cycle it"
            )
        return kept - self.factory[name]


def check_offset(name: str, offset: int, wide: bool) -> None:
    """Raise ``ArgumentError`` for an unknown bias or an offset outside its range.

    - ``wide``: Allow the wide range, which may make the sensor noisy or insensitive.
    """
    if name not in BIASES:
        raise ArgumentError(f"bias {name!r} is unknown; choose one of {', '.join(BIASES)}")
    low, high = BIASES[name].wide if wide else BIASES[name].normal
    if not low <= offset <= high:
        raise ArgumentError(f"{name} is {offset}; choose {low} to {high}")


def load_bias_file(path: str | os.PathLike[str]) -> dict[str, int]:
    """Return the offsets in a ``.bias`` file: ``value % name`` per line, ``%`` begins a comment.

    Biases that users do not set (``bias_diff``) are skipped.

    Raises ``FormatError`` for a file that cannot be read or a line that is no bias.
    """
    try:
        lines = read_regular_file(path, _BYTES_MAX, FormatError).decode().splitlines()
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: it is not text; give a bias file") from error
    offsets: dict[str, int] = {}
    for number, line in enumerate(lines, 1):
        value, _, name = (part.strip() for part in line.partition("%"))
        if not value:
            continue
        try:
            offset = int(value)
        except ValueError as error:
            raise FormatError(
                f"{path} line {number}: {short(line)} is no bias; write 'value % name'"
            ) from error
        name = name.split()[0] if name else ""
        if name in BIASES:
            offsets[name] = offset
        elif not name.startswith("bias_"):
            raise FormatError(
                f"{path} line {number}: {short(line)} names no bias; write 'value % name'"
            )
    return offsets


def save_bias_file(path: str | os.PathLike[str], offsets: Mapping[str, int]) -> None:
    """Write offsets as a ``.bias`` file; raises ``ArgumentError`` when it cannot be written."""
    text = "".join(f"{offset}  % {name}\n" for name, offset in offsets.items())
    with atomic_write(path) as stream:
        stream.write(text.encode())
