"""The EVK4's control protocol, device side: one request frame in, one answer frame out.

Source: openeb 5.1.1 (tz_libusb_board_command.cpp). Frames are u32 property, u32 payload bytes,
payload, little-endian. A refused request answers ``property | 0x80000000``, an unknown one the
bare ``0x80000000``.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

FAILED = 0x80000000
WRITE = 0x40000000
REGISTERS = 0x10102
ANSWER_WORDS_MAX = 252


class RegisterAccess(Protocol):
    """The registers that requests access."""

    def read(self, address: int) -> int:
        """Read a register."""

    def write(self, address: int, value: int) -> None:
        """Write a register."""


@dataclass(frozen=True, slots=True)
class BoardIdentity:
    """Properties of the board."""

    serial: int = 0x00051234
    firmware: int = 0x030900
    build_date_s: int = 1_700_000_000
    name: str = "EVK4"
    compatible: tuple[str, ...] = ("psee,ccam5_imx636", "psee,ccam5_gen42")
    interface_hz: int = 100_000_000


def frame(property_: int, payload: bytes = b"") -> bytes:
    """Return a frame."""
    return struct.pack("<II", property_, len(payload)) + payload


def _words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def _strings(device: int, *texts: str) -> bytes:
    return _words(device) + b"".join(text.encode() + b"\0" for text in texts)


class TreuzellBoard:
    """A board with one sensor, device 0, that answers requests.

    Parameters
    ----------
    identity : BoardIdentity
    registers : RegisterAccess
    """

    def __init__(self, identity: BoardIdentity, registers: RegisterAccess):
        self._identity = identity
        self._registers = registers
        self._properties: dict[int, Callable[[], bytes]] = {
            0x71: lambda: _words(1),
            0x72: lambda: struct.pack("<Q", identity.serial),
            0x79: lambda: _words(identity.firmware),
            0x7A: lambda: struct.pack("<Q", identity.build_date_s),
            0x10000: lambda: _words(1),
        }
        self._of_device: dict[int, Callable[[], bytes]] = {
            0x10001: lambda: _strings(0, identity.name),
            0x10002: lambda: _words(0, identity.interface_hz),
            0x10003: lambda: _strings(0, *identity.compatible),
            0x10010: lambda: _words(0),
            0x10200: lambda: _words(0),
            0x10201: lambda: _strings(0, "EVT3"),
        }

    def answer(self, request: bytes) -> bytes:
        """Return the answer to a request."""
        if len(request) < 8:
            return frame(FAILED)
        property_, size = struct.unpack_from("<II", request)
        payload = request[8:]
        if size != len(payload) or size % 4:
            return frame(property_ | FAILED, _words(0, 0, errno.EINVAL))
        base = property_ & ~WRITE
        if base == REGISTERS:
            return self._register_request(property_, payload)
        if base in self._of_device:
            if len(payload) < 4 or payload[:4] != _words(0):
                return frame(property_ | FAILED, _words(0, 0, errno.ENODEV))
            return frame(property_, self._of_device[base]())
        if property_ in self._properties:
            return frame(property_, self._properties[property_]())
        return frame(FAILED)

    def _register_request(self, property_: int, payload: bytes) -> bytes:
        words = struct.unpack(f"<{len(payload) // 4}I", payload)
        if len(words) < 3:
            return frame(property_ | FAILED, _words(0, 0, errno.EINVAL))
        device, address, *rest = words
        if device:
            return frame(property_ | FAILED, _words(device, address, errno.ENODEV))
        if property_ & WRITE:
            if address % 4:
                return frame(property_ | FAILED, _words(device, address, errno.EINVAL))
            for index, value in enumerate(rest):
                self._registers.write(address + 4 * index, value)
            return frame(property_, _words(device, address, *rest))
        count = rest[0]
        if address % 4 or not 0 < count <= ANSWER_WORDS_MAX:
            return frame(property_ | FAILED, _words(device, address, errno.EINVAL))
        values = (self._registers.read(address + 4 * index) for index in range(count))
        return frame(property_, _words(device, address, *values))
