"""USB descriptors as pyusb reads them from a backend."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Protocol

import usb.backend

from eschorty_ros.emulation.bus.usb_device import BULK, SPEED_SUPER, UsbIdentity


class Described(Protocol):
    """A device in the list of a bus."""

    identity: UsbIdentity
    bus: int
    address: int


class DescriptorBackend(usb.backend.IBackend):
    """The part of pyusb's backend interface that reads descriptors.

    pyusb counts configurations, interfaces and settings until an ``IndexError``.
    """

    def get_parent(self, dev: Described) -> None:
        """Return ``None``: there is no hub."""

    def get_device_descriptor(self, dev: Described) -> SimpleNamespace:
        """Return the device's descriptor."""
        identity = dev.identity
        usb3 = identity.speed >= SPEED_SUPER
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0320 if usb3 else 0x0200,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=9 if usb3 else 64,
            idVendor=identity.vendor_id,
            idProduct=identity.product_id,
            bcdDevice=identity.bcd_device,
            iManufacturer=1 if identity.manufacturer else 0,
            iProduct=2 if identity.product else 0,
            iSerialNumber=3 if identity.serial else 0,
            bNumConfigurations=1,
            bus=dev.bus,
            address=dev.address,
            port_number=1,
            port_numbers=(1,),
            speed=identity.speed,
        )

    def get_configuration_descriptor(self, dev: Described, config: int) -> SimpleNamespace:
        """Return the descriptor of the only configuration."""
        _only_one(config)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=18 + 7 * len(dev.identity.endpoints),
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0x80,
            bMaxPower=50,
            extra_descriptors=[],
        )

    def get_interface_descriptor(
        self, dev: Described, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Return the descriptor of the only interface."""
        _only_one(intf)
        _only_one(alt)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=len(dev.identity.endpoints),
            bInterfaceClass=dev.identity.interface_class,
            bInterfaceSubClass=dev.identity.interface_subclass,
            bInterfaceProtocol=dev.identity.interface_protocol,
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(
        self, dev: Described, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Return an endpoint's descriptor."""
        endpoint = dev.identity.endpoints[ep]
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=endpoint.address,
            bmAttributes=BULK,
            wMaxPacketSize=endpoint.max_packet,
            bInterval=0,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )


def _only_one(index: int) -> None:
    if index:
        raise IndexError(index)
