"""USBTMC on a pyusb device: messages out, replies in, every header checked.

USB-IF "Universal Serial Bus Test and Measurement Class" 1.0, tables 1 to 9. A reply ends with the
end of message (EOM) in its header, not with a newline, and nothing is requested after it: a second
request for the same reply wedges some instruments until they are plugged in again.
"""

from __future__ import annotations

import struct
import time
from typing import Any

import usb.core
import usb.util

from eschorty_ros.core.base.errors import DeviceError, DeviceStallError
from eschorty_ros.hardware.base.usb import claim, release, translated

INTERFACE_CLASS, INTERFACE_SUBCLASS = 0xFE, 0x03
REPLY_LIMIT = 65_536
"""Longest reply that is accepted, bytes."""

_HEADER = struct.Struct("<BBBBIB3x")
_MESSAGE_OUT, _REQUEST_IN, _REPLY_IN = 1, 2, 2
_END_OF_MESSAGE = 0x01
_REQUEST_MAX_BYTES = 4096
_INITIATE_CLEAR, _CHECK_CLEAR = 5, 6
_CLASS_INTERFACE_IN = 0xA1
_STATUS_SUCCESS, _STATUS_PENDING = 0x01, 0x02
_CLEAR_TRIES = 32


def is_usbtmc(device: usb.core.Device) -> bool:
    """Return whether a device has a USBTMC interface, from its descriptors alone."""
    return any(_is_tmc(interface) for configuration in device for interface in configuration)


def _is_tmc(interface: Any) -> bool:
    kind = (interface.bInterfaceClass, interface.bInterfaceSubClass)
    return kind == (INTERFACE_CLASS, INTERFACE_SUBCLASS)


class UsbTmc:
    """A USBTMC instrument on a pyusb device; the interface is claimed until ``close``.

    - ``name``: Name of the instrument in errors.
    - ``timeout_s``: Longest wait for one transfer.

    Raises ``DeviceError`` when there is no USBTMC interface, or another program holds it.
    """

    def __init__(self, device: usb.core.Device, *, name: str, timeout_s: float) -> None:
        self._device = device
        self._name = name
        self._timeout_ms = max(1, round(timeout_s * 1e3))
        self._tag = 0
        try:
            interface = self._tmc_interface()
            self._interface = interface.bInterfaceNumber
            self._out = self._endpoint(interface, usb.util.ENDPOINT_OUT)
            self._in = self._endpoint(interface, usb.util.ENDPOINT_IN)
            self._packet = self._in.wMaxPacketSize
            self._detached = claim(device, self._interface, name)
        except DeviceError:
            usb.util.dispose_resources(device)
            raise
        self.serial = self._read_serial()

    def write(self, message: bytes) -> None:
        """Send one message in one transfer.

        Raises ``DeviceError``: gone, timed out, stalled or cut short; then call ``clear``.
        """
        header = _HEADER.pack(*self._tags(_MESSAGE_OUT), 0, len(message), _END_OF_MESSAGE)
        self._send(header + message + bytes(-len(message) % 4), "sending a command")

    def read(self) -> bytes:
        """Return one reply, joined up to its end of message.

        Raises ``DeviceError``: gone, timed out, stalled, a wrong header, or a reply above 64 kB;
        then call ``clear``.
        """
        reply = b""
        while True:
            part, ended = self._read_transfer()
            reply += part
            if ended:
                return reply
            if len(reply) > REPLY_LIMIT:
                raise DeviceError(
                    f"{self._name}: a reply is longer than {REPLY_LIMIT} bytes; "
                    "check that the profile fits the instrument"
                )

    def clear(self) -> None:
        """Clear the buffers of both sides, then the halt of both endpoints.

        Raises ``DeviceError`` when the instrument does not answer.
        """
        try:
            self._clear_buffers()
        except DeviceStallError:
            pass  # The instrument does not know the request.
        finally:
            self._clear_halts()

    def reset(self) -> None:
        """Reset the USB port; raises ``DeviceError`` when that fails."""
        with translated(f"{self._name}: resetting the port"):
            self._device.reset()

    def close(self) -> None:
        """Release the interface, give it back to the kernel driver it came from; never raises."""
        release(self._device, self._interface, reattach=self._detached)

    def _tmc_interface(self) -> Any:
        with translated(f"{self._name}: opening"):
            configuration = self._device.get_active_configuration()
        for interface in configuration:
            if _is_tmc(interface):
                return interface
        raise DeviceError(f"{self._name}: it has no USBTMC interface; check vendor and product id")

    def _endpoint(self, interface: Any, direction: int) -> Any:
        for endpoint in interface:
            address, kind = endpoint.bEndpointAddress, endpoint.bmAttributes
            bulk = usb.util.endpoint_type(kind) == usb.util.ENDPOINT_TYPE_BULK
            if bulk and usb.util.endpoint_direction(address) == direction:
                return endpoint
        raise DeviceError(f"{self._name}: a bulk endpoint is missing; it is no USBTMC instrument")

    def _read_serial(self) -> str:
        try:
            return self._device.serial_number or ""
        except (usb.core.USBError, ValueError):
            return ""

    def _tags(self, message_id: int) -> tuple[int, int, int]:
        self._tag = self._tag % 255 + 1
        return message_id, self._tag, self._tag ^ 0xFF

    def _send(self, data: bytes, what: str) -> None:
        with translated(f"{self._name}: {what}"):
            sent = self._device.write(self._out.bEndpointAddress, data, self._timeout_ms)
        if sent != len(data):
            raise self._broken(f"{what}: {sent} of {len(data)} bytes went out")

    def _broken(self, what: str) -> DeviceError:
        """Return the error of a transfer that came through, but not as it should be."""
        return DeviceError(f"{self._name}: {what}; check cable and hub")

    def _receive(self, size: int) -> bytes:
        with translated(f"{self._name}: reading a reply"):
            return bytes(self._device.read(self._in.bEndpointAddress, size, self._timeout_ms))

    def _read_transfer(self) -> tuple[bytes, bool]:
        """Return the data of one reply transfer, and whether the message ends with it.

        The first packet is read alone: its header holds the size, and a reply of full packets that
        no empty packet follows would block a larger read until the time-out.
        """
        header = _HEADER.pack(*self._tags(_REQUEST_IN), 0, _REQUEST_MAX_BYTES, 0)
        self._send(header, "asking for a reply")
        # An empty packet may still end the previous transfer.
        data = self._receive(self._packet) or self._receive(self._packet)
        size, ended = self._checked(data)
        missing = _HEADER.size + size - len(data)
        if missing > 0 and len(data) == self._packet:
            data += self._receive(-(-missing // self._packet) * self._packet)
        if len(data) < _HEADER.size + size:
            brought = len(data) - _HEADER.size
            raise self._broken(f"a reply announced {size} bytes and brought {brought}")
        return data[_HEADER.size : _HEADER.size + size], ended

    def _checked(self, data: bytes) -> tuple[int, bool]:
        """Return size and end mark of a reply header; refuses one for another request."""
        if len(data) < _HEADER.size:
            raise self._broken(f"a reply of {len(data)} bytes is too short")
        kind, tag, inverse, _, size, attributes = _HEADER.unpack_from(data)
        if (kind, tag, inverse) != (_REPLY_IN, self._tag, self._tag ^ 0xFF):
            wrong = "tag" if kind == _REPLY_IN else f"message id, {kind},"
            raise self._broken(f"a reply header has the wrong {wrong} for its request")
        if size > _REQUEST_MAX_BYTES:
            raise self._broken(
                f"a reply announced {size} bytes, {_REQUEST_MAX_BYTES} were requested"
            )
        return size, bool(attributes & _END_OF_MESSAGE)

    def _clear_buffers(self) -> None:
        if self._control(_INITIATE_CLEAR, 1)[0] != _STATUS_SUCCESS:
            raise DeviceError(f"{self._name}: refused to clear its buffers; switch it off and on")
        ends = time.monotonic() + self._timeout_ms * 1e-3
        for _ in range(_CLEAR_TRIES):
            status, more = self._control(_CHECK_CLEAR, 2)
            if status != _STATUS_PENDING:
                return
            if more & 1:
                # The instrument goes on when this data has been read.
                self._receive(self._packet)
            if time.monotonic() > ends:
                break
        raise DeviceError(f"{self._name}: does not end clearing; switch it off and on")

    def _control(self, request: int, size: int) -> bytes:
        with translated(f"{self._name}: clearing"):
            answer = self._device.ctrl_transfer(
                _CLASS_INTERFACE_IN, request, 0, self._interface, size, self._timeout_ms
            )
        if len(answer) < size:
            raise self._broken(f"clearing was answered with {len(answer)} bytes")
        return bytes(answer)

    def _clear_halts(self) -> None:
        for endpoint in (self._out, self._in):
            with translated(f"{self._name}: clearing a halt"):
                self._device.clear_halt(endpoint.bEndpointAddress)
