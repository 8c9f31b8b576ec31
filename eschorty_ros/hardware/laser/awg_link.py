"""Opening the generator: over libusb, or through the kernel's ``/dev/usbtmcN``."""

from __future__ import annotations

import usb.core

from eschorty_ros.hardware.laser.awg_channel import NAME
from eschorty_ros.hardware.laser.awg_profile import AwgProfile
from eschorty_ros.hardware.laser.awg_settings import AwgSettings
from eschorty_ros.hardware.laser.usbtmc import MessageLink, UsbTmc, is_usbtmc
from eschorty_ros.hardware.laser.usbtmc_file import UsbTmcFile
from eschorty_ros.hardware.usb import find_device, open_backend


def open_link(settings: AwgSettings, profile: AwgProfile, serial: str = "") -> MessageLink:
    """Find the generator afresh and claim it.

    Parameters
    ----------
    settings : AwgSettings
    profile : AwgProfile
    serial : str
        Taken where the settings name no serial: a generator that comes back is the same one.

    Raises
    ------
    DeviceError
        None, several, no permission, or held by another program: one line with the remedy.
    """
    if settings.device:
        return UsbTmcFile(settings.device, name=NAME, timeout_s=settings.usb_timeout)
    vendors = settings.vendors() or profile.usb.vendor_ids

    def matches(device: usb.core.Device) -> bool:
        known = device.idProduct in profile.usb.product_ids and device.idVendor in vendors
        return known and is_usbtmc(device)

    backend = open_backend(settings.backend)
    device = find_device(backend, name=NAME, matches=matches, serial=settings.serial or serial)
    return UsbTmc(device, name=NAME, timeout_s=settings.usb_timeout)
