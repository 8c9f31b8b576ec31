"""Receiving from the data endpoint: the interface of a reader, and a synchronous one on pyusb."""

from __future__ import annotations

import array
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

import usb.core

from eschorty_ros.core.base.errors import DeviceTimeoutError
from eschorty_ros.hardware.base.usb import translate

TRANSFER_BYTES = 128 << 10
_NAME = "camera: reading events"

ClockNs = Callable[[], int]


class BulkReader(Protocol):
    """Reads one bulk endpoint, in one thread."""

    def start(self) -> None:
        """Discard what the device still holds, then be ready to receive."""

    def resume(self) -> None:
        """Be ready again after a failed transfer; keeps what the device still holds."""

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Return bytes and their arrival time (ns); ``b""`` when none came.

        Raises ``DeviceStallError``, ``DeviceGoneError`` or ``DeviceError``.
        """

    def stop(self) -> None:
        """Stop receiving; idempotent."""


class SyncReader:
    """Reads one transfer at a time over pyusb, into a buffer that is reused.

    Between two reads only the camera's USB bridge buffers data: enough for a line scene,
    unconfirmed on hardware for more.
    """

    def __init__(self, device: usb.core.Device, endpoint: int, clock_ns: ClockNs) -> None:
        self._device = device
        self._endpoint = endpoint
        self._clock_ns = clock_ns
        self._buffer = array.array("B", bytes(TRANSFER_BYTES))
        self._view = memoryview(self._buffer)

    def start(self) -> None:
        """Clear a halt and empty the endpoint."""
        self.resume()
        drain(self._device, self._endpoint, self._buffer)

    def resume(self) -> None:
        """Clear a halt."""
        try:
            self._device.clear_halt(self._endpoint)
        except usb.core.USBError as error:
            raise translate(error, _NAME) from error

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Read one transfer."""
        try:
            # libusb takes 0 ms as unlimited.
            count = self._device.read(self._endpoint, self._buffer, max(int(timeout_s * 1e3), 1))
        except usb.core.USBError as error:
            failure = translate(error, _NAME)
            if isinstance(failure, DeviceTimeoutError):
                return b"", self._clock_ns()
            raise failure from error
        return bytes(self._view[:count]), self._clock_ns()

    def stop(self) -> None:
        """Do nothing: no transfer is pending between two reads."""


def drain(device: usb.core.Device, endpoint: int, buffer: array.array[int]) -> None:
    """Read ``endpoint`` until it is empty, at most 64 transfers."""
    with suppress(usb.core.USBError):
        for _ in range(_DRAIN_MAX):
            device.read(endpoint, buffer, _DRAIN_MS)


_DRAIN_MAX = 64
_DRAIN_MS = 10
