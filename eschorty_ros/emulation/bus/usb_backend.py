"""A pyusb backend for devices in memory: ``usb.core.find(backend=EmulatedBackend(...))``."""

from __future__ import annotations

import array
import errno
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn

import usb.core

from eschorty_ros.emulation.bus.usb_descriptors import DescriptorBackend
from eschorty_ros.emulation.bus.usb_device import DIRECTION_IN, EmulatedUsbDevice, UsbFault

Buffer = array.array | bytearray | memoryview

# libusb's codes of the same errors.
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
    """Raise the error that pyusb raises on libusb for this error number."""
    kind = usb.core.USBTimeoutError if code == errno.ETIMEDOUT else usb.core.USBError
    raise kind(os.strerror(code), _LIBUSB_CODES.get(code, -99), code)


class Handle:
    """A device as listed or opened; invalid once it was unplugged or closed."""

    def __init__(self, device: EmulatedUsbDevice):
        self.device = device
        self.identity = device.identity
        self.bus = device.bus
        self.address = device.address
        self.closed = False

    def require(self) -> EmulatedUsbDevice:
        """Return the device; raises when it was closed, unplugged or plugged in again."""
        if self.closed or self.device.gone or self.device.address != self.address:
            raise UsbFault(errno.ENODEV)
        return self.device


class EmulatedBackend(DescriptorBackend):
    """pyusb's backend interface for models.

    - ``models``: Returns the devices on the bus.
    """

    def __init__(self, models: Callable[[], Sequence[EmulatedUsbDevice]]):
        self._models = models

    def enumerate_devices(self) -> Iterator[Handle]:
        """List the devices on the bus, without unplugged ones."""
        return (Handle(device) for device in self._models() if not device.gone)

    def open_device(self, dev: Handle) -> Handle:
        """Open; EACCES when the device is ``denied``."""
        device = self._run(dev.require)
        if device.denied:
            raise_usb_error(errno.EACCES)
        return Handle(device)

    def close_device(self, dev_handle: Handle) -> None:
        """Close and free what the handle claimed."""
        dev_handle.closed = True
        dev_handle.device.free(dev_handle)

    def set_configuration(self, dev_handle: Handle, config_value: int) -> None:
        """Accept the only configuration."""
        self._run(dev_handle.require)

    def get_configuration(self, dev_handle: Handle) -> int:
        """Return the only configuration."""
        self._run(dev_handle.require)
        return 1

    def set_interface_altsetting(self, dev_handle: Handle, intf: int, altsetting: int) -> None:
        """Reset the device side of the interface."""
        device = self._owned(dev_handle, intf)
        with device.mutex:
            device.reset()

    def claim_interface(self, dev_handle: Handle, intf: int) -> None:
        """Claim; EBUSY while a kernel driver or another handle holds it."""
        device = self._run(dev_handle.require)
        with device.mutex:
            if device.kernel_driver or device.claims.get(intf, dev_handle) is not dev_handle:
                raise_usb_error(errno.EBUSY)
            device.claims[intf] = dev_handle

    def release_interface(self, dev_handle: Handle, intf: int) -> None:
        """Release the interface."""
        self._owned(dev_handle, intf).free(dev_handle)

    def bulk_write(self, dev_handle: Handle, ep: int, intf: int, data: Buffer, timeout: int) -> int:
        """Send a transfer."""
        device = self._owned(dev_handle, intf)

        def transfer() -> int:
            device.before_transfer(ep, timeout)
            with device.mutex:
                return device.bulk_out(ep, bytes(data), timeout)

        return self._run(transfer)

    def bulk_read(self, dev_handle: Handle, ep: int, intf: int, buff: Buffer, timeout: int) -> int:
        """Receive a transfer into ``buff``; returns the bytes received."""
        dev_handle.device.begin_read(ep)
        device = self._owned(dev_handle, intf)
        size = memoryview(buff).nbytes

        def transfer() -> bytes:
            device.before_transfer(ep, timeout)
            return device.bulk_in(ep, size, timeout)

        return _fill(buff, self._run(transfer))

    def ctrl_transfer(
        self,
        dev_handle: Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Buffer,
        timeout: int,
    ) -> int:
        """Run a control request; returns the bytes sent or received."""

        def transfer() -> bytes | int:
            device = dev_handle.require()
            device.before_transfer(0, timeout)
            to_host = bmRequestType & DIRECTION_IN
            with device.mutex:
                return device.control(
                    bmRequestType,
                    bRequest,
                    wValue,
                    wIndex,
                    memoryview(data).nbytes if to_host else bytes(data),
                    timeout,
                )

        answer = self._run(transfer)
        return answer if isinstance(answer, int) else _fill(data, answer)

    def clear_halt(self, dev_handle: Handle, ep: int) -> None:
        """Clear a stall."""
        device = self._run(dev_handle.require)
        with device.mutex:
            device.clear_halt(ep)

    def reset_device(self, dev_handle: Handle) -> None:
        """Reset the device; its address stays."""
        device = self._run(dev_handle.require)
        with device.mutex:
            device.reset()

    def is_kernel_driver_active(self, dev_handle: Handle, intf: int) -> bool:
        """Return whether a kernel driver holds the interface."""
        return bool(self._run(dev_handle.require).kernel_driver)

    def detach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Detach the kernel driver from the interface."""
        device = self._run(dev_handle.require)
        if not device.kernel_driver:
            raise_usb_error(errno.ENOENT)
        device.detached_driver, device.kernel_driver = device.kernel_driver, None

    def attach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Attach the detached kernel driver again."""
        device = self._run(dev_handle.require)
        if not device.detached_driver:
            raise_usb_error(errno.ENOENT)
        device.kernel_driver, device.detached_driver = device.detached_driver, None

    def _owned(self, handle: Handle, interface: int) -> EmulatedUsbDevice:
        """Return the device; raises when another handle claimed the interface."""
        device = self._run(handle.require)
        if device.claims.get(interface, handle) is not handle:
            raise_usb_error(errno.EBUSY)
        return device

    @staticmethod
    def _run(transfer: Callable[[], Any]) -> Any:
        try:
            return transfer()
        except UsbFault as fault:
            raise_usb_error(fault.errno)


def _fill(buffer: Buffer, data: bytes) -> int:
    memoryview(buffer).cast("B")[: len(data)] = data
    return len(data)
