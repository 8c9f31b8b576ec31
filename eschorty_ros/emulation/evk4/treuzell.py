"""The EVK4's control protocol, device side: one request frame in, one answer frame out.

Source: openeb 5.1.1 (tz_libusb_board_command.cpp). Frames are u32 property, u32 payload bytes,
payload, little-endian. A refused request answers ``property | 0x80000000``, an unknown one the
bare ``0x80000000``.
"""

from __future__ import annotations

import errno
import struct
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


def frame(property_: int, payload: bytes = b"") -> bytes:
    """Return a frame."""
    return struct.pack("<II", property_, len(payload)) + payload


def _words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


class TreuzellBoard:
    """A board with one sensor, device 0, that answers requests."""

    def __init__(self, identity: BoardIdentity, registers: RegisterAccess):
        self._registers = registers
        self._properties = {
            0x72: struct.pack("<Q", identity.serial),
            0x79: _words(identity.firmware),
            0x10000: _words(1),
        }

    def answer(self, request: bytes) -> bytes:
        """Return the answer to a request."""
        if len(request) < 8:
            return frame(FAILED)
        property_, size = struct.unpack_from("<II", request)
        payload = request[8:]
        if size != len(payload) or size % 4:
            return frame(property_ | FAILED, _words(0, 0, errno.EINVAL))
        if property_ & ~WRITE == REGISTERS:
            return self._register_request(property_, payload)
        if property_ in self._properties:
            return frame(property_, self._properties[property_])
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
