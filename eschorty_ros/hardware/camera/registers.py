"""Access to the sensor's 32-bit registers, and sequences of accesses as data."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from eschorty_ros.core.base.errors import DeviceError

FULL = 0xFFFF_FFFF

Sleep = Callable[[float], None]
"""Waits some seconds."""

_TOKEN = re.compile(
    r"/(?P<wait>[\d.]+)(?P<unit>s|ms|us)/"
    r"|(?P<address>[0-9A-F]+)(\[(?P<mask>[0-9A-F]+)\])?=(?P<value>[0-9A-F]+)"
)
_US = {"s": 1e6, "ms": 1e3, "us": 1.0}


class Registers(Protocol):
    """Registers of one sensor; both methods raise ``DeviceError`` when it does not answer."""

    def read(self, address: int) -> int:
        """Return the register at ``address``."""

    def write(self, address: int, value: int) -> None:
        """Replace the register at ``address``."""


@dataclass(frozen=True, slots=True)
class Write:
    """Writes ``value`` where ``mask`` has ones; the other bits are read first and kept."""

    address: int
    value: int
    mask: int = FULL


@dataclass(frozen=True, slots=True)
class Wait:
    """Waits ``us`` microseconds."""

    us: float


Step = Write | Wait


def parse_sequence(text: str) -> tuple[Step, ...]:
    """Parse a sequence: ``addr=value`` and ``addr[mask]=value`` in hex, ``/1ms/`` waits.

    Raises ``ValueError`` for any other token.
    """
    return tuple(_steps(text.split()))


def _steps(tokens: Iterable[str]) -> Iterator[Step]:
    for token in tokens:
        found = _TOKEN.fullmatch(token)
        if found is None:
            raise ValueError(f"{token!r} is no register access and no wait")
        if found["wait"]:
            yield Wait(float(found["wait"]) * _US[found["unit"]])
        else:
            mask = int(found["mask"], 16) if found["mask"] else FULL
            yield Write(int(found["address"], 16), int(found["value"], 16), mask)


def run_sequence(registers: Registers, steps: Iterable[Step], sleep: Sleep) -> None:
    """Execute ``steps`` in order; raises ``DeviceError`` when the device does not answer."""
    for step in steps:
        if isinstance(step, Wait):
            sleep(step.us * 1e-6)
        elif step.mask == FULL:
            registers.write(step.address, step.value)
        else:
            update(registers, step.address, step.mask, step.value)


def update(registers: Registers, address: int, mask: int, value: int) -> None:
    """Replace the bits of ``mask``, keep the others."""
    kept = registers.read(address) & ~mask & FULL
    registers.write(address, kept | (value & mask))


def await_bits(registers: Registers, address: int, mask: int, tries: int, what: str) -> int:
    """Read until all bits of ``mask`` are set; returns the last value.

    Raises ``DeviceError`` when they are not set after ``tries`` reads; names ``what``.
    """
    value = 0
    for _ in range(tries):
        value = registers.read(address)
        if value & mask == mask:
            return value
    raise DeviceError(
        f"camera: {what} is not ready (register {address:04X} reads {value:08X} after {tries} "
        "tries); close and open the camera, or power-cycle it"
    )
