"""USB access of the drivers: a backend by name, one device found, its interface claimed.

A backend named ``module:callable`` or ``module:callable?argument`` is imported at run time, so that
an emulated device replaces a real one with the driver unchanged.
"""

from __future__ import annotations

import errno
import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import usb.backend
import usb.backend.libusb1
import usb.core
import usb.util

from eschorty_ros.core.base.errors import (
    ArgumentError,
    DeviceError,
    DeviceGoneError,
    DeviceStallError,
    DeviceTimeoutError,
)

_KINDS: dict[int, tuple[type[DeviceError], str]] = {
    errno.ENODEV: (DeviceGoneError, "the device is gone; check cable and power, then reconnect"),
    errno.ENXIO: (DeviceGoneError, "the device is gone; check cable and power, then reconnect"),
    errno.ETIMEDOUT: (DeviceTimeoutError, "no answer in time; check that the device is on"),
    errno.EPIPE: (DeviceStallError, "the device stalled the transfer"),
    errno.EOVERFLOW: (DeviceError, "more data than requested; the transfer is lost"),
    errno.EIO: (DeviceError, "transfer failed; check cable and hub"),
    errno.EACCES: (
        DeviceError,
        "permission denied; install the udev rules of docs/hardware.md and plug in again",
    ),
    errno.EBUSY: (
        DeviceError,
        "in use; close the other program, or unload the kernel driver that holds it",
    ),
}


def translate(error: usb.core.USBError, what: str) -> DeviceError:
    """Return the ``DeviceError`` for pyusb's error, by ``errno``: texts differ by platform.

    - ``what``: Device and operation, such as ``"EVK4 00051234: reading register 0x0014"``.
    """
    code = error.errno if error.errno is not None else 0
    kind, remedy = _KINDS.get(code, (DeviceError, str(error.strerror or error)))
    return kind(f"{what}: {remedy} ({errno.errorcode.get(code, 'no error number')})")


@contextmanager
def translated(what: str) -> Iterator[None]:
    """Raise pyusb's errors as a ``DeviceError``; see `translate`."""
    try:
        yield
    except usb.core.USBError as error:
        raise translate(error, what) from error


def open_backend(spec: str) -> usb.backend.IBackend:
    """Return the pyusb backend that ``spec`` names.

    - ``spec``: ``libusb``: the system's libusb, else that of the package ``libusb-package``.
      ``module:callable`` or ``module:callable?argument``: the result of ``callable()`` or
      ``callable(argument)``.

    Raises ``ArgumentError`` for a name that cannot be imported. Raises ``DeviceError`` without
    libusb.
    """
    if spec == "libusb":
        return _libusb()
    target, _, argument = spec.partition("?")
    module, _, name = target.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ArgumentError(
            f"backend {spec!r}: {error}; use libusb or module:callable[?argument]"
        ) from error
    return factory(argument) if argument else factory()


def _libusb() -> usb.backend.IBackend:
    backend = usb.backend.libusb1.get_backend()
    if backend is None:
        with suppress(ImportError):
            import libusb_package

            backend = libusb_package.get_libusb1_backend()
    if backend is None:
        raise DeviceError("libusb not found; install libusb-1.0-0 (apt) or libusb-package (pip)")
    return backend


def find_device(
    backend: usb.backend.IBackend,
    *,
    name: str,
    matches: Callable[[usb.core.Device], bool],
    serial: str = "",
) -> usb.core.Device:
    """Find and open the one device that matches; returns a new ``Device`` on every call.

    - ``name``: Name of the device in messages.
    - ``matches``: May read descriptors only: the device is not open yet.
    - ``serial``: Serial string, upper or lower case; ``""`` for the only match.

    Raises ``DeviceGoneError`` when none matches. Raises ``DeviceError`` when several match, or
    opening is refused.
    """
    others: list[str] = []
    with translated(f"{name}: looking for it on the bus"):
        found = list(usb.core.find(find_all=True, backend=backend, custom_match=matches))
        if serial:
            found, others = _with_serial(found, serial, name)
    if not found:
        which = f" with serial {serial}" if serial else ""
        there = f"; there is {', '.join(others)}" if others else ""
        raise DeviceGoneError(
            f"{name}: no such device{which} on the bus{there}; check cable, power and serial"
        )
    if len(found) > 1:
        places = ", ".join(map(_place, found))
        raise DeviceError(f"{name}: {len(found)} devices match ({places}); give the serial")
    device = found[0]
    try:
        device.get_active_configuration()
    except usb.core.USBError as error:
        usb.util.dispose_resources(device)
        raise translate(error, f"{name}: opening {_place(device)}") from error
    return device


def _place(device: usb.core.Device) -> str:
    return f"bus {device.bus} address {device.address}"


def _with_serial(
    devices: list[usb.core.Device], serial: str, name: str
) -> tuple[list[usb.core.Device], list[str]]:
    """Return the devices with that serial, and the serials of all others."""
    kept, others = [], []
    for device in devices:
        text = _serial(device, name)
        if text.lower() == serial.lower():
            kept.append(device)
        else:
            others.append(text or f"one without serial at {_place(device)}")
            usb.util.dispose_resources(device)
    return kept, others


def _serial(device: usb.core.Device, name: str) -> str:
    try:
        # pyusb reports a refused open as "no language"; opening first keeps the reason.
        device.get_active_configuration()
        return device.serial_number or ""
    except usb.core.USBError as error:
        usb.util.dispose_resources(device)
        raise translate(error, f"{name}: opening {_place(device)}") from error
    except ValueError:
        return ""


def claim(device: usb.core.Device, interface: int, name: str) -> bool:
    """Claim the interface for this process; returns whether a kernel driver was detached.

    Raises ``DeviceError`` when another program holds it, or the kernel driver cannot be detached.
    """
    detached = False
    with translated(f"{name}: claiming interface {interface}"):
        with suppress(NotImplementedError):
            if device.is_kernel_driver_active(interface):
                device.detach_kernel_driver(interface)
                detached = True
        usb.util.claim_interface(device, interface)
    return detached


def release(device: usb.core.Device, interface: int, *, reattach: bool) -> None:
    """Release the interface, reattach the kernel driver if requested, close; never raises."""
    with suppress(usb.core.USBError):
        usb.util.release_interface(device, interface)
    if reattach:
        with suppress(usb.core.USBError, NotImplementedError):
            device.attach_kernel_driver(interface)
    usb.util.dispose_resources(device)
