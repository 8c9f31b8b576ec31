"""Control frames of Prophesee's USB boards ("Treuzell"): packing, checking, register access.

A frame is a u32 property, a u32 payload size and the payload, little-endian, both ways. A failed
request is answered with the property's top bit set.
"""

from __future__ import annotations

import struct
import threading
from typing import Protocol

from eschorty_ros.core.base.errors import DeviceError, DeviceStallError, DeviceTimeoutError

SERIAL = 0x72
FIRMWARE = 0x79
DEVICE_COUNT = 0x10000
REGISTERS = 0x10102
WRITE = 0x4000_0000
FAILED = 0x8000_0000

_HEADER = struct.Struct("<II")
_DEVICE = 0


class FrameError(DeviceError):
    """An answer that does not belong to the request."""


class ControlLink(Protocol):
    """One request out, one answer in; raises ``DeviceError`` subclasses."""

    def send(self, frame: bytes) -> None:
        """Write a request."""

    def receive(self) -> bytes:
        """Read one answer."""

    def recover(self) -> None:
        """Clear stalls and discard waiting answers."""


def request_frame(property_id: int, payload: bytes) -> bytes:
    """Return the frame of a request."""
    return _HEADER.pack(property_id, len(payload)) + payload


def answer_payload(property_id: int, frame: bytes) -> bytes:
    """Check an answer and return its payload.

    Raises ``FrameError`` when it is short, has another size than its header says, or answers
    another request. Raises ``DeviceError`` when the camera refused.
    """
    if len(frame) < _HEADER.size:
        raise FrameError(
            f"camera: answer to {property_id:X} has {len(frame)} bytes, a header needs 8; "
            "the request is sent again once"
        )
    answered, size = _HEADER.unpack_from(frame)
    if size != len(frame) - _HEADER.size:
        raise FrameError(
            f"camera: answer to {property_id:X} announces {size} payload bytes and has "
            f"{len(frame) - _HEADER.size}; the request is sent again once"
        )
    payload = frame[_HEADER.size :]
    if answered == FAILED:
        raise DeviceError(
            f"camera: request {property_id:X} is unknown to the firmware; update the camera"
        )
    if answered == property_id | FAILED:
        code = struct.unpack_from("<I", payload, 8)[0] if len(payload) >= 12 else 0
        raise DeviceError(
            f"camera: request {property_id:X} failed with errno {code}; "
            "close and open the camera, or power-cycle it"
        )
    if answered != property_id:
        raise FrameError(
            f"camera: answer to {property_id:X} is one to {answered:X}; "
            "the request is sent again once"
        )
    return payload


class Treuzell:
    """Request and answer over a :class:`ControlLink`, one at a time; thread-safe.

    After a time-out, a stall or an answer to another request the link is cleared and the request
    sent once more: every request here is idempotent. A second failure is raised.

    Public attributes:
    - ``requests``, ``recoveries``: Requests answered, and times the link was cleared.
    - ``retries``: Whether a failed request is sent once more.
    """

    def __init__(self, link: ControlLink) -> None:
        self._link = link
        self._lock = threading.Lock()
        self.retries = True
        self.requests = 0
        self.recoveries = 0

    def request(self, property_id: int, payload: bytes = b"") -> bytes:
        """Send a request and return the answer's payload.

        Raises ``DeviceError``: ``DeviceGoneError`` when unplugged, ``DeviceTimeoutError`` without
        an answer, :class:`FrameError` for a wrong one, plain when the camera refused.
        """
        frame = request_frame(property_id, payload)
        with self._lock:
            answer = self._exchange(property_id, frame, payload)
            self.requests += 1
        return answer

    def read(self, address: int) -> int:
        """Read a sensor register."""
        return struct.unpack_from("<I", self._access(REGISTERS, address, 1), 8)[0]

    def write(self, address: int, value: int) -> None:
        """Write a sensor register."""
        self._access(REGISTERS | WRITE, address, value)

    def _access(self, property_id: int, address: int, word: int) -> bytes:
        return self.request(property_id, struct.pack("<III", _DEVICE, address, word))

    def _exchange(self, property_id: int, frame: bytes, payload: bytes) -> bytes:
        try:
            return self._once(property_id, frame, payload)
        except (DeviceTimeoutError, DeviceStallError, FrameError):
            if not self.retries:
                raise
            self.recoveries += 1
            self._link.recover()
        return self._once(property_id, frame, payload)

    def _once(self, property_id: int, frame: bytes, payload: bytes) -> bytes:
        self._link.send(frame)
        answer = answer_payload(property_id, self._link.receive())
        if property_id & ~WRITE == REGISTERS:
            # The answer repeats device and address, so a late one is recognised.
            needed = 8 if property_id & WRITE else 12
            if answer[:8] != payload[:8] or len(answer) < needed:
                raise FrameError(
                    f"camera: an answer that is not about register {payload[4:8][::-1].hex()}, "
                    f"but {answer.hex()}; the request is sent again once"
                )
        return answer
