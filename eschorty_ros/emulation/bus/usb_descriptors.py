"""USB descriptors as pyusb reads them from a backend."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Protocol

import usb.backend

from eschorty_ros.emulation.bus.usb_device import BULK, SPEED_SUPER, UsbIdentity


def _device(identity: UsbIdentity, bus: int, address: int) -> SimpleNamespace:
    return SimpleNamespace(
        bLength=18,
        bDescriptorType=1,
        bcdUSB=0x0320 if identity.speed >= SPEED_SUPER else 0x0200,
        bDeviceClass=0,
        bDeviceSubClass=0,
        bDeviceProtocol=0,
        bMaxPacketSize0=9 if identity.speed >= SPEED_SUPER else 64,
        idVendor=identity.vendor_id,
        idProduct=identity.product_id,
        bcdDevice=identity.bcd_device,
        iManufacturer=1 if identity.manufacturer else 0,
        iProduct=2 if identity.product else 0,
        iSerialNumber=3 if identity.serial else 0,
        bNumConfigurations=1,
        bus=bus,
        address=address,
        port_number=1,
        port_numbers=(1,),
        speed=identity.speed,
    )


def _configuration(identity: UsbIdentity) -> SimpleNamespace:
    return SimpleNamespace(
        bLength=9,
        bDescriptorType=2,
        wTotalLength=18 + 7 * len(identity.endpoints),
        bNumInterfaces=1,
        bConfigurationValue=1,
        iConfiguration=0,
        bmAttributes=0x80,
        bMaxPower=50,
        extra_descriptors=[],
    )


def _interface(identity: UsbIdentity) -> SimpleNamespace:
    return SimpleNamespace(
        bLength=9,
        bDescriptorType=4,
        bInterfaceNumber=0,
        bAlternateSetting=0,
        bNumEndpoints=len(identity.endpoints),
        bInterfaceClass=identity.interface_class,
        bInterfaceSubClass=identity.interface_subclass,
        bInterfaceProtocol=identity.interface_protocol,
        iInterface=0,
        extra_descriptors=[],
    )


def _endpoint(identity: UsbIdentity, index: int) -> SimpleNamespace:
    endpoint = identity.endpoints[index]
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


class Described(Protocol):
    """A device in the list of a bus."""

    @property
    def identity(self) -> UsbIdentity:
        """Return its descriptors."""

    @property
    def bus(self) -> int:
        """Return the number of the bus."""

    @property
    def address(self) -> int:
        """Return its address."""


class DescriptorBackend(usb.backend.IBackend):
    """The part of pyusb's backend interface that reads descriptors.

    pyusb counts configurations, interfaces and settings until an ``IndexError``.
    """

    def get_parent(self, dev: Described) -> None:
        """Return ``None``: there is no hub."""

    def get_device_descriptor(self, dev: Described) -> SimpleNamespace:
        """Return the device's descriptor."""
        return _device(dev.identity, dev.bus, dev.address)

    def get_configuration_descriptor(self, dev: Described, config: int) -> SimpleNamespace:
        """Return the descriptor of the only configuration."""
        _only_one(config)
        return _configuration(dev.identity)

    def get_interface_descriptor(
        self, dev: Described, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Return the descriptor of the only interface."""
        _only_one(intf)
        _only_one(alt)
        return _interface(dev.identity)

    def get_endpoint_descriptor(
        self, dev: Described, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Return an endpoint's descriptor."""
        return _endpoint(dev.identity, ep)


def _only_one(index: int) -> None:
    if index:
        raise IndexError(index)
