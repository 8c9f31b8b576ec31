"""Emulated USB buses and serial ports, in this process or in another."""

from eschorty_ros.emulation.bus.pty_port import PtyPort
from eschorty_ros.emulation.bus.usb_backend import EmulatedBackend
from eschorty_ros.emulation.bus.usb_device import (
    SPEED_SUPER,
    EmulatedUsbDevice,
    EndpointIdentity,
    UsbFault,
    UsbIdentity,
    Wait,
)
from eschorty_ros.emulation.bus.usb_server import UsbServer

__all__ = [
    "SPEED_SUPER",
    "EmulatedBackend",
    "EmulatedUsbDevice",
    "EndpointIdentity",
    "PtyPort",
    "UsbFault",
    "UsbIdentity",
    "UsbServer",
    "Wait",
]
