"""A pyusb backend whose bus is in another process: ``usb_remote:backend?/path/usb.sock``."""

from __future__ import annotations

import array
import errno
import json
import socket
import threading
from collections.abc import Callable
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

_ANSWER_TIMEOUT_S = 20.0
"""Beyond a transfer's own time-out; then the link is closed, as of an unplugged device."""


_CLOCK_SET_NS = 10_000_000_000


class _Link:
    """One connection, one request at a time."""

    def __init__(self, path: str):
        self.late_ns = 0
        self._lock = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(_ANSWER_TIMEOUT_S)
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
                self._socket.settimeout(
                    timeout_ms / 1e3 + _ANSWER_TIMEOUT_S if timeout_ms else None
                )
                send_request(self._socket, op, numbers, data)
                code, size, self.late_ns = receive_answer(self._socket)
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


class _ListedDevice:
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


def _forwarded(op: Op) -> Callable[..., int]:
    """Return the backend's method that forwards ``op`` with its numbers."""

    def method(_: RemoteBackend, dev_handle: _RemoteHandle, *numbers: int) -> int:
        return int.from_bytes(dev_handle.main.call(op, numbers), "little")

    return method


class RemoteBackend(DescriptorBackend):
    """pyusb's backend interface on the socket of a ``UsbServer``; the bus is empty without one.

    - ``path``: Path of the socket.
    """

    def __init__(self, path: str):
        self._path = path
        self._late_ns = 0

    def enumerate_devices(self) -> list[_ListedDevice]:
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
            return [_ListedDevice(entry) for entry in json.loads(link.call(Op.LIST))]
        finally:
            link.close()

    def open_device(self, dev: _ListedDevice) -> _RemoteHandle:
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
        dev_handle.main.call(Op.GET_CONFIGURATION)

    get_configuration = _forwarded(Op.GET_CONFIGURATION)
    set_interface_altsetting = _forwarded(Op.SET_INTERFACE_ALTSETTING)
    claim_interface = _forwarded(Op.CLAIM_INTERFACE)
    release_interface = _forwarded(Op.RELEASE_INTERFACE)
    clear_halt = _forwarded(Op.CLEAR_HALT)
    reset_device = _forwarded(Op.RESET_DEVICE)
    is_kernel_driver_active = _forwarded(Op.IS_KERNEL_DRIVER_ACTIVE)
    detach_kernel_driver = _forwarded(Op.DETACH_KERNEL_DRIVER)
    attach_kernel_driver = _forwarded(Op.ATTACH_KERNEL_DRIVER)

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
        view, link = memoryview(buff).cast("B"), dev_handle.link(ep)
        try:
            return int(link.call(Op.READ, (ep, len(view), timeout), timeout_ms=timeout, into=view))
        finally:
            # A read without data has its time, too.
            self._late_ns = link.late_ns

    def transfer_clock(self, clock_ns: Callable[[], int]) -> Callable[[], int]:
        """Return the clock by which the last transfer read would have come from a real device.

        It goes back only with the host's clock.
        """
        newest_ns = 0

        def clock() -> int:
            nonlocal newest_ns
            t_ns = clock_ns() - self._late_ns
            if not 0 < newest_ns - t_ns < _CLOCK_SET_NS:
                newest_ns = t_ns
            return newest_ns

        return clock

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


def backend(path: str) -> RemoteBackend:
    """Return the backend whose bus is served at the socket ``path``."""
    return RemoteBackend(path)
