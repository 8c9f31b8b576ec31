"""A pyusb backend over devices in memory: ``usb.core.find(backend=EmulatedBackend(...))``."""

from __future__ import annotations

import array
import errno
import os
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, NoReturn

import usb.backend
import usb.core

from eschorty_ros.emulation.usb_descriptors import (
    configuration_descriptor,
    device_descriptor,
    endpoint_descriptor,
    interface_descriptor,
)
from eschorty_ros.emulation.usb_device import DIRECTION_IN, EmulatedUsbDevice, UsbFault

# What libusb calls the same faults.
_LIBUSB_CODES = {
    errno.EIO: -1,
    errno.EINVAL: -2,
    errno.EACCES: -3,
    errno.ENODEV: -4,
    errno.ENOENT: -5,
    errno.EBUSY: -6,
    errno.ETIMEDOUT: -7,
    errno.EOVERFLOW: -8,
    errno.EPIPE: -9,
}


def raise_usb_error(code: int) -> NoReturn:
    """Raise what pyusb raises over libusb for this error number."""
    kind = usb.core.USBTimeoutError if code == errno.ETIMEDOUT else usb.core.USBError
    raise kind(os.strerror(code), _LIBUSB_CODES.get(code, -99), code)


class _Handle:
    """One opening of a device; dead for good once the device was unplugged."""

    def __init__(self, device: EmulatedUsbDevice):
        self.device = device
        self.address = device.address

    def live(self) -> EmulatedUsbDevice:
        if self.device.gone or self.device.address != self.address:
            raise UsbFault(errno.ENODEV)
        return self.device


class EmulatedBackend(usb.backend.IBackend):
    """pyusb's backend interface over models.

    Parameters
    ----------
    models : callable
        Gives the devices that are on the bus now.
    """

    def __init__(self, models: Callable[[], Sequence[EmulatedUsbDevice]]):
        self._models = models

    def enumerate_devices(self) -> Iterator[_Handle]:
        """Devices on the bus; unplugged ones are not listed."""
        return (_Handle(device) for device in self._models() if not device.gone)

    def get_parent(self, dev: _Handle) -> None:
        """No hub in between."""

    def get_device_descriptor(self, dev: _Handle) -> SimpleNamespace:
        """Describe the device."""
        return device_descriptor(dev.device.identity, dev.device.bus, dev.address)

    def get_configuration_descriptor(self, dev: _Handle, config: int) -> SimpleNamespace:
        """Describe the only configuration."""
        _index(config, 1)
        return configuration_descriptor(dev.device.identity)

    def get_interface_descriptor(
        self, dev: _Handle, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Describe the only interface."""
        _index(intf, 1)
        _index(alt, 1)
        return interface_descriptor(dev.device.identity)

    def get_endpoint_descriptor(
        self, dev: _Handle, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Describe an endpoint."""
        _index(ep, len(dev.device.identity.endpoints))
        return endpoint_descriptor(dev.device.identity, ep)

    def open_device(self, dev: _Handle) -> _Handle:
        """Open; EACCES when the device is ``denied``."""
        device = self._run(dev.live)
        if device.denied:
            raise_usb_error(errno.EACCES)
        return _Handle(device)

    def close_device(self, dev_handle: _Handle) -> None:
        """Close and free what the handle claimed."""
        claims = dev_handle.device.claims
        for interface in [i for i, owner in claims.items() if owner is dev_handle]:
            del claims[interface]

    def set_configuration(self, dev_handle: _Handle, config_value: int) -> None:
        """Take the only configuration."""
        self._run(dev_handle.live)

    def get_configuration(self, dev_handle: _Handle) -> int:
        """Tell the only configuration."""
        self._run(dev_handle.live)
        return 1

    def set_interface_altsetting(self, dev_handle: _Handle, intf: int, altsetting: int) -> None:
        """Reset the device side of the interface."""
        device = self._owned(dev_handle, intf)
        with device.mutex:
            device.reset()

    def claim_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Claim; EBUSY while a kernel driver or another handle holds it."""
        device = self._run(dev_handle.live)
        with device.mutex:
            if device.kernel_driver or device.claims.get(intf, dev_handle) is not dev_handle:
                raise_usb_error(errno.EBUSY)
            device.claims[intf] = dev_handle

    def release_interface(self, dev_handle: _Handle, intf: int) -> None:
        """Give the interface back."""
        device = self._owned(dev_handle, intf)
        with device.mutex:
            device.claims.pop(intf, None)

    def bulk_write(
        self, dev_handle: _Handle, ep: int, intf: int, data: array.array[int], timeout: int
    ) -> int:
        """Send a transfer."""
        device = self._owned(dev_handle, intf)

        def transfer() -> int:
            device.before_transfer(ep, timeout)
            with device.mutex:
                return device.bulk_out(ep, data.tobytes(), timeout)

        return self._run(transfer)

    def bulk_read(
        self, dev_handle: _Handle, ep: int, intf: int, buff: array.array[int], timeout: int
    ) -> int:
        """Receive a transfer into ``buff``; returns the bytes received."""
        device = self._owned(dev_handle, intf)
        size = len(buff) * buff.itemsize

        def transfer() -> bytes:
            device.before_transfer(ep, timeout)
            return device.bulk_in(ep, size, timeout)

        return _fill(buff, self._run(transfer))

    def ctrl_transfer(
        self,
        dev_handle: _Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array.array[int],
        timeout: int,
    ) -> int:
        """Run a control request; returns the bytes sent or received."""

        def transfer() -> bytes | int:
            device = dev_handle.live()
            device.before_transfer(0, timeout)
            to_host = bmRequestType & DIRECTION_IN
            with device.mutex:
                return device.control(
                    bmRequestType,
                    bRequest,
                    wValue,
                    wIndex,
                    len(data) * data.itemsize if to_host else data.tobytes(),
                    timeout,
                )

        answer = self._run(transfer)
        return answer if isinstance(answer, int) else _fill(data, answer)

    def clear_halt(self, dev_handle: _Handle, ep: int) -> None:
        """Clear a stall."""
        device = self._run(dev_handle.live)
        with device.mutex:
            device.clear_halt(ep)

    def reset_device(self, dev_handle: _Handle) -> None:
        """Reset the device; its address stays."""
        device = self._run(dev_handle.live)
        with device.mutex:
            device.reset()

    def is_kernel_driver_active(self, dev_handle: _Handle, intf: int) -> bool:
        """Tell whether a kernel driver holds the interface."""
        return bool(self._run(dev_handle.live).kernel_driver)

    def detach_kernel_driver(self, dev_handle: _Handle, intf: int) -> None:
        """Take the interface from the kernel driver."""
        device = self._run(dev_handle.live)
        if not device.kernel_driver:
            raise_usb_error(errno.ENOENT)
        device.detached_driver, device.kernel_driver = device.kernel_driver, None

    def attach_kernel_driver(self, dev_handle: _Handle, intf: int) -> None:
        """Give the interface back to the kernel driver it was taken from."""
        device = self._run(dev_handle.live)
        if not device.detached_driver:
            raise_usb_error(errno.ENOENT)
        device.kernel_driver, device.detached_driver = device.detached_driver, None

    def _owned(self, handle: _Handle, interface: int) -> EmulatedUsbDevice:
        """Give the live device, unless somebody else claimed the interface."""
        device = self._run(handle.live)
        if device.claims.get(interface, handle) is not handle:
            raise_usb_error(errno.EBUSY)
        return device

    @staticmethod
    def _run(transfer: Callable[[], Any]) -> Any:
        try:
            return transfer()
        except UsbFault as fault:
            raise_usb_error(fault.errno)


def _index(value: int, size: int) -> None:
    """Tell pyusb, which counts until an IndexError, where the list ends."""
    if not 0 <= value < size:
        raise IndexError(value)


def _fill(buffer: array.array[int], data: bytes) -> int:
    memoryview(buffer).cast("B")[: len(data)] = data
    return len(data)
