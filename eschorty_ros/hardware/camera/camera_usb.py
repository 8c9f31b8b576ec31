"""The EVK4 on the USB bus: found by its interface's descriptors, claimed, its three endpoints.

Source: openeb 5.1.1 ``tz_libusb_board_command.cpp``, ``psee_universal.cpp``. Unconfirmed on
hardware.
"""

from __future__ import annotations

import array
from contextlib import suppress
from typing import NamedTuple

import usb.backend
import usb.core
import usb.util

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError, EschortyError
from eschorty_ros.hardware.base import usb as bus
from eschorty_ros.hardware.camera import treuzell
from eschorty_ros.hardware.camera.bulk_reader import drain

NAME = "EVK4 camera"
_VENDOR = 0x04B4
_PRODUCT = 0x00F5
_INTERFACE = 0
_INTERFACE_CLASS = (0xFF, 0x19, 0x00)
_DIRECTIONS = (usb.util.ENDPOINT_IN, usb.util.ENDPOINT_OUT, usb.util.ENDPOINT_IN)
_ALTSETTING_SINCE = 0x0307
_ANSWER_BYTES = 1024
_TIMEOUT_MS = 1000
_CLOSING_TIMEOUT_MS = 200


class Endpoints(NamedTuple):
    """Addresses of the three bulk endpoints."""

    control_in: int
    control_out: int
    data_in: int


def _endpoints(device: usb.core.Device) -> Endpoints | None:
    """Return a camera's endpoints, ``None`` when the device has other descriptors."""
    try:
        interface = device[0][(_INTERFACE, 0)]
    except (usb.core.USBError, IndexError, KeyError, NotImplementedError):
        return None
    classes = (
        interface.bInterfaceClass,
        interface.bInterfaceSubClass,
        interface.bInterfaceProtocol,
    )
    endpoints = list(interface.endpoints())
    bulk = all(
        usb.util.endpoint_type(e.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK for e in endpoints
    )
    addresses = [e.bEndpointAddress for e in endpoints]
    directions = tuple(usb.util.endpoint_direction(address) for address in addresses)
    if classes != _INTERFACE_CLASS or not bulk or directions != _DIRECTIONS:
        return None
    return Endpoints(*addresses)


def _is_camera(device: usb.core.Device) -> bool:
    """Return whether the descriptors are those of an EVK4."""
    return (
        device.idVendor == _VENDOR
        and device.idProduct == _PRODUCT
        and _endpoints(device) is not None
    )


class CameraUsb:
    """A claimed camera; a :class:`~eschorty_ros.hardware.camera.treuzell.ControlLink`.

    Public attributes:
    - ``slow``: True when the link is slower than 5 Gbit/s.
    """

    def __init__(self, device: usb.core.Device) -> None:
        endpoints = _endpoints(device)
        if endpoints is None:
            raise DeviceError(f"{NAME}: the device has other endpoints than an EVK4; unplug it")
        self.device = device
        self.endpoints = endpoints
        self.slow = device.speed is not None and device.speed < usb.util.SPEED_SUPER
        self._timeout_ms = _TIMEOUT_MS
        self._answer = array.array("B", bytes(_ANSWER_BYTES))
        try:
            self._reattach = bus.claim(device, _INTERFACE, NAME)
        except DeviceError:
            usb.util.dispose_resources(device)
            raise
        try:
            if device.bcdDevice >= _ALTSETTING_SINCE:
                device.set_interface_altsetting(_INTERFACE, 0)
        except usb.core.USBError as error:
            self.close()
            raise bus.translate(error, f"{NAME}: selecting its interface") from error

    def send(self, frame: bytes) -> None:
        """Write a request."""
        request = int.from_bytes(frame[:4], "little")
        with bus.translated(f"{NAME}: request {request:X}"):
            self.device.write(self.endpoints.control_out, frame, self._timeout_ms)

    def receive(self) -> bytes:
        """Read an answer."""
        with bus.translated(f"{NAME}: waiting for an answer"):
            count = self.device.read(self.endpoints.control_in, self._answer, self._timeout_ms)
        return self._answer[:count].tobytes()

    def recover(self) -> None:
        """Clear halts of both control endpoints and discard waiting answers."""
        for endpoint in (self.endpoints.control_out, self.endpoints.control_in):
            with bus.translated(f"{NAME}: clearing endpoint {endpoint:#x}"):
                self.device.clear_halt(endpoint)
        drain(self.device, self.endpoints.control_in, self._answer)

    def shorten_timeouts(self) -> None:
        """Wait less for answers from now on, because the camera is being closed."""
        self._timeout_ms = _CLOSING_TIMEOUT_MS

    def close(self) -> None:
        """Release the interface; never raises."""
        bus.release(self.device, _INTERFACE, reattach=self._reattach)


def open_camera(backend: usb.backend.IBackend, serial: str) -> CameraUsb:
    """Claim the camera with that serial (hex, upper or lower case), or the only one on the bus.

    The serial is read over the control protocol, because USB descriptors need not hold it.

    Raises ``DeviceGoneError`` when none is there, or none with that serial. Raises ``DeviceError``
    when several are there and no serial is given, or it cannot be opened.
    """
    if not serial:
        return CameraUsb(bus.find_device(backend, name=NAME, matches=_is_camera))
    others: list[str] = []
    with bus.translated(f"{NAME}: looking for it on the bus"):
        found = list(usb.core.find(find_all=True, backend=backend, custom_match=_is_camera))
    for place in [(device.bus, device.address) for device in found]:
        try:
            camera = CameraUsb(_find(backend, place))
        except DeviceError as error:
            others.append(str(error))
            continue
        try:
            its_serial = read_serial(treuzell.Treuzell(camera))
        except EschortyError as error:
            camera.close()
            others.append(str(error))
            continue
        if _same_serial(its_serial, serial):
            return camera
        camera.close()
        others.append(its_serial)
    if not others:
        raise DeviceGoneError(
            f"{NAME}: none with serial {serial} on the bus; check cable, power and serial"
        )
    raise DeviceGoneError(
        f"{NAME}: none with serial {serial} can be opened, but there is {', '.join(others)}; "
        "check cable, power and serial"
    )


def read_serial(control: treuzell.Treuzell) -> str:
    """Read the camera's serial number: lower-case hex, at least 8 digits, as openeb prints it."""
    payload = control.request(treuzell.SERIAL)
    if len(payload) not in (4, 8):
        raise DeviceError(
            f"{NAME}: its serial number has {len(payload)} bytes, not 4 or 8; update the camera"
        )
    return f"{int.from_bytes(payload, 'little'):08x}"


def _same_serial(one: str, other: str) -> bool:
    """Return whether two serials are equal; openeb prints up to 16 digits, labels the last 8."""
    with suppress(ValueError):
        return int(one, 16) & 0xFFFF_FFFF == int(other, 16) & 0xFFFF_FFFF
    return one.lower() == other.lower()


def _find(backend: usb.backend.IBackend, place: tuple[int, int]) -> usb.core.Device:
    return bus.find_device(
        backend,
        name=NAME,
        matches=lambda device: _is_camera(device) and (device.bus, device.address) == place,
    )
