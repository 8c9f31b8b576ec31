"""A pyusb backend whose bus is in another process: ``usb_remote:backend?/path/usb.sock``."""

from __future__ import annotations

import array
import errno
import json
import socket
import threading
from contextlib import suppress
from typing import Any

import usb.core

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.bus.usb_backend import raise_usb_error
from eschorty_ros.emulation.bus.usb_descriptors import DescriptorBackend
from eschorty_ros.emulation.bus.usb_device import DIRECTION_IN, EndpointIdentity, UsbIdentity
from eschorty_ros.emulation.bus.usb_wire import (
    Closed,
    Op,
    receive_answer,
    receive_into,
    send_request,
)

_GRACE_S = 20.0
"""After this, a stopped or overloaded server counts as an unplugged device."""


class _Link:
    """One connection, one request at a time."""

    def __init__(self, path: str):
        self._lock = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(_GRACE_S)
            self._socket.connect(path)
        except OSError:
            self._socket.close()
            raise

    def call(
        self,
        op: Op,
        numbers: tuple[int, ...] = (),
        data: bytes = b"",
        *,
        timeout_ms: int = 1,
        into: memoryview | None = None,
    ) -> Any:
        """Return the answer to a request, or its length when it is received ``into`` a buffer."""
        with self._lock:
            try:
                self._socket.settimeout(timeout_ms / 1e3 + _GRACE_S if timeout_ms else None)
                send_request(self._socket, op, numbers, data)
                code, size = receive_answer(self._socket)
                view = memoryview(bytearray(size)) if into is None else into[:size]
                receive_into(self._socket, view)
            except TimeoutError:
                # A late answer would pass for that of the next request, and the data of a late read
                # would be missing unnoticed.
                self._socket.close()
                code = errno.ENODEV if op is Op.READ else errno.ETIMEDOUT
            except (Closed, OSError):
                self._socket.close()
                code = errno.ENODEV
        if code:
            raise_usb_error(code)
        return bytes(view) if into is None else size

    @property
    def open(self) -> bool:
        return self._socket.fileno() >= 0

    def close(self) -> None:
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class _Seen:
    """A device as the server listed it."""

    def __init__(self, entry: dict[str, Any]):
        identity = dict(entry["identity"])
        endpoints = tuple(EndpointIdentity(**e) for e in identity.pop("endpoints"))
        self.identity = UsbIdentity(**identity, endpoints=endpoints)
        self.bus = int(entry["bus"])
        self.address = int(entry["address"])


class _RemoteHandle:
    """An opened device: one link that holds it open, and one per endpoint for transfers."""

    def __init__(self, path: str, address: int):
        self._path = path
        self.main = _Link(path)
        self._token = int.from_bytes(_first(self.main, Op.OPEN, address), "little")
        self._lock = threading.Lock()
        self._transfers: dict[int, _Link] = {}

    def link(self, endpoint: int) -> _Link:
        with self._lock:
            link = self._transfers.get(endpoint)
            if link is None or not link.open:
                if not self.main.open:
                    raise_usb_error(errno.ENODEV)
                try:
                    link = _Link(self._path)
                except OSError:
                    raise_usb_error(errno.ENODEV)
                _first(link, Op.JOIN, self._token)
                self._transfers[endpoint] = link
            return link

    def close(self) -> None:
        self.main.close()
        with self._lock:
            for link in self._transfers.values():
                link.close()


def _first(link: _Link, op: Op, number: int) -> bytes:
    """Run the first request of a link; closes the link when it fails."""
    try:
        answer: bytes = link.call(op, (number,))
    except usb.core.USBError:
        link.close()
        raise
    return answer


class RemoteBackend(DescriptorBackend):
    """pyusb's backend interface on the socket of a ``UsbServer``; the bus is empty without one.

    Parameters
    ----------
    path : str
        Path of the socket.
    """

    def __init__(self, path: str):
        self._path = path

    def enumerate_devices(self) -> list[_Seen]:
        """List the devices on the server's bus."""
        try:
            link = _Link(self._path)
        except (FileNotFoundError, ConnectionError, TimeoutError):
            return []
        except OSError as error:
            raise DeviceError(
                f"USB socket {self._path}: {error.strerror or error}; check the path"
            ) from error
        try:
            return [_Seen(entry) for entry in json.loads(link.call(Op.LIST))]
        finally:
            link.close()

    def open_device(self, dev: _Seen) -> _RemoteHandle:
        """Open the device."""
        try:
            return _RemoteHandle(self._path, dev.address)
        except (FileNotFoundError, ConnectionError):
            raise_usb_error(errno.ENODEV)

    def close_device(self, dev_handle: _RemoteHandle) -> None:
        """Close; the server frees the claims."""
        dev_handle.close()

    def set_configuration(self, dev_handle: _RemoteHandle, config_value: int) -> None:
        """Accept the only configuration."""
        dev_handle.main.call(Op.CONFIGURATION)

    def get_configuration(self, dev_handle: _RemoteHandle) -> int:
        """Return the only configuration."""
        dev_handle.main.call(Op.CONFIGURATION)
        return 1

    def set_interface_altsetting(
        self, dev_handle: _RemoteHandle, intf: int, altsetting: int
    ) -> None:
        """Reset the device side of the interface."""
        dev_handle.main.call(Op.ALT_SETTING, (intf, altsetting))

    def claim_interface(self, dev_handle: _RemoteHandle, intf: int) -> None:
        """Claim the interface for this handle alone."""
        dev_handle.main.call(Op.CLAIM, (intf,))

    def release_interface(self, dev_handle: _RemoteHandle, intf: int) -> None:
        """Release the interface."""
        dev_handle.main.call(Op.RELEASE, (intf,))

    def bulk_write(
        self, dev_handle: _RemoteHandle, ep: int, intf: int, data: array.array[int], timeout: int
    ) -> int:
        """Send a transfer."""
        answer = dev_handle.link(ep).call(
            Op.WRITE, (ep, timeout), data.tobytes(), timeout_ms=timeout
        )
        return int.from_bytes(answer, "little")

    def bulk_read(
        self, dev_handle: _RemoteHandle, ep: int, intf: int, buff: array.array[int], timeout: int
    ) -> int:
        """Receive a transfer into ``buff``; returns the bytes received."""
        view = memoryview(buff).cast("B")
        return dev_handle.link(ep).call(
            Op.READ, (ep, len(view), timeout), timeout_ms=timeout, into=view
        )

    def ctrl_transfer(
        self,
        dev_handle: _RemoteHandle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array.array[int],
        timeout: int,
    ) -> int:
        """Run a control request; returns the bytes sent or received."""
        view = memoryview(data).cast("B")
        to_host = bmRequestType & DIRECTION_IN
        numbers = (bmRequestType << 8 | bRequest, wValue << 16 | wIndex, len(view), timeout)
        link = dev_handle.link(0)
        if to_host:
            return link.call(Op.CONTROL, numbers, timeout_ms=timeout, into=view)
        return int.from_bytes(
            link.call(Op.CONTROL, numbers, bytes(view), timeout_ms=timeout), "little"
        )

    def clear_halt(self, dev_handle: _RemoteHandle, ep: int) -> None:
        """Clear a stall."""
        dev_handle.main.call(Op.CLEAR_HALT, (ep,))

    def reset_device(self, dev_handle: _RemoteHandle) -> None:
        """Reset the device."""
        dev_handle.main.call(Op.RESET)

    def is_kernel_driver_active(self, dev_handle: _RemoteHandle, intf: int) -> bool:
        """Return whether a kernel driver holds the interface."""
        return dev_handle.main.call(Op.DRIVER_ACTIVE, (intf,)) == b"\x01"

    def detach_kernel_driver(self, dev_handle: _RemoteHandle, intf: int) -> None:
        """Take the interface from the kernel driver."""
        dev_handle.main.call(Op.DRIVER_DETACH, (intf,))

    def attach_kernel_driver(self, dev_handle: _RemoteHandle, intf: int) -> None:
        """Give the interface back to the kernel driver."""
        dev_handle.main.call(Op.DRIVER_ATTACH, (intf,))


def backend(path: str) -> RemoteBackend:
    """Return the backend whose bus is served at the socket ``path``."""
    return RemoteBackend(path)
