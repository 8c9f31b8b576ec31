"""USBTMC through Linux's ``usbtmc`` driver: the kernel does tags, headers and joining.

For machines where libusb may not detach that driver. ioctl numbers from ``linux/usb/tmc.h``;
those a kernel does not know are done without. Unconfirmed on hardware.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import struct

from eschorty_ros.core.errors import DeviceError, DeviceGoneError, DeviceTimeoutError
from eschorty_ros.hardware.laser.usbtmc import REPLY_LIMIT

_CLEAR, _CLEAR_OUT_HALT, _CLEAR_IN_HALT = 0x5B02, 0x5B06, 0x5B07
_SET_TIMEOUT = 0x40045B0A
_REPLY_ATTRIBUTES = 0x80015B18
_END_OF_MESSAGE = 0x01
_UNKNOWN_REQUEST = (errno.ENOTTY, errno.EINVAL)
_SHORTEST_TIMEOUT_MS = 100
"""The kernel takes no less."""

_REMEDIES = {
    errno.ENOENT: "no such device; check cable, power and the number in its name",
    errno.EACCES: "permission denied; install the udev rules of docs/hardware.md and plug in again",
    errno.EBUSY: "in use; close the other program",
}


class RawFile:
    """The device file itself, locked against a second program of this package."""

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOCTTY)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._fd)
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY)) from None

    def read(self, size: int) -> bytes:
        """Read at most ``size`` bytes."""
        return os.read(self._fd, size)

    def write(self, data: bytes) -> int:
        """Write; returns the bytes taken."""
        return os.write(self._fd, data)

    def ioctl(self, request: int, argument: bytes) -> bytes:
        """Run an ioctl whose argument is a buffer."""
        return bytes(fcntl.ioctl(self._fd, request, argument))

    def close(self) -> None:
        """Close."""
        os.close(self._fd)


class UsbTmcFile:
    """A USBTMC instrument behind ``/dev/usbtmcN``.

    Parameters
    ----------
    path : str
    name : str
        What errors call the instrument.
    timeout_s : float
        Longest wait for one transfer; the kernel takes no less than 0.1 s.
    opener : callable
        Makes the ``RawFile`` of a path.

    Raises
    ------
    DeviceError
        When the file cannot be opened.
    """

    def __init__(
        self, path: str, *, name: str, timeout_s: float, opener: type[RawFile] = RawFile
    ) -> None:
        self._what = f"{name} at {path}"
        self.serial = ""
        try:
            self._file = opener(path)
        except OSError as error:
            raise self._translated(error, "opening") from error
        self._open = True
        milliseconds = max(_SHORTEST_TIMEOUT_MS, round(timeout_s * 1e3))
        self._ioctl(_SET_TIMEOUT, struct.pack("=I", milliseconds), "setting the time-out")

    def write(self, message: bytes) -> None:
        """Send one message.

        Raises
        ------
        DeviceError
            Gone, timed out or cut short.
        """
        try:
            sent = self._file.write(message)
        except OSError as error:
            raise self._translated(error, "sending a command") from error
        if sent != len(message):
            raise DeviceError(
                f"{self._what}: sending a command: {sent} of {len(message)} bytes went out"
            )

    def read(self) -> bytes:
        """Take one reply, joined up to its end of message.

        Raises
        ------
        DeviceError
            Gone, timed out, or a reply above 64 kB.
        """
        reply = b""
        while len(reply) <= REPLY_LIMIT:
            try:
                reply += self._file.read(REPLY_LIMIT)
            except OSError as error:
                raise self._translated(error, "reading a reply") from error
            if self._ended():
                return reply
        raise DeviceError(
            f"{self._what}: a reply is longer than {REPLY_LIMIT} bytes; "
            "check that the profile fits the instrument"
        )

    def clear(self) -> None:
        """Clear buffers and the halts of both endpoints; raises ``DeviceError``."""
        for request in (_CLEAR, _CLEAR_OUT_HALT, _CLEAR_IN_HALT):
            self._ioctl(request, b"", "clearing")

    def reset(self) -> None:
        """Nothing: the kernel offers no reset here; opening again has to do."""

    def close(self) -> None:
        """Close the file; idempotent, never raises."""
        if self._open:
            self._open = False
            with contextlib.suppress(OSError):
                self._file.close()

    def _ended(self) -> bool:
        """Whether the last transfer ended the message; kernels that cannot tell: it did."""
        answer = self._ioctl(_REPLY_ATTRIBUTES, b"\0", "reading a reply")
        return answer is None or bool(answer[0] & _END_OF_MESSAGE)

    def _ioctl(self, request: int, argument: bytes, what: str) -> bytes | None:
        try:
            return self._file.ioctl(request, argument)
        except OSError as error:
            if error.errno in _UNKNOWN_REQUEST:
                return None
            raise self._translated(error, what) from error

    def _translated(self, error: OSError, what: str) -> DeviceError:
        text = f"{self._what}: {what}"
        if error.errno in (errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN):
            return DeviceGoneError(f"{text}: the device is gone; check cable and power")
        if error.errno == errno.ENOENT:
            return DeviceGoneError(f"{text}: {_REMEDIES[errno.ENOENT]}")
        if error.errno == errno.ETIMEDOUT:
            return DeviceTimeoutError(f"{text}: no answer in time; check that the device is on")
        remedy = _REMEDIES.get(error.errno or 0, f"{error.strerror or error}; check the cable")
        return DeviceError(f"{text}: {remedy}")
