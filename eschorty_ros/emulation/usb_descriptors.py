"""USB descriptors as pyusb reads them from a backend: plain fields."""

from __future__ import annotations

from types import SimpleNamespace

from eschorty_ros.emulation.usb_device import BULK, SPEED_SUPER, UsbIdentity


def device_descriptor(identity: UsbIdentity, bus: int, address: int) -> SimpleNamespace:
    """Describe the device as it sits on the bus."""
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


def configuration_descriptor(identity: UsbIdentity) -> SimpleNamespace:
    """Describe the only configuration."""
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


def interface_descriptor(identity: UsbIdentity) -> SimpleNamespace:
    """Describe the only interface."""
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


def endpoint_descriptor(identity: UsbIdentity, index: int) -> SimpleNamespace:
    """Describe the bulk endpoint at this place in the list."""
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
