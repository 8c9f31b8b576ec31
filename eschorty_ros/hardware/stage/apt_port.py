"""The controller's serial port: found by its USB serial number, opened exclusively."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import time
from typing import Any

import serial
from serial.tools import list_ports

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.hardware.stage.apt_link import SerialPort

BAUD = 115_200
# First digits of the USB serial numbers of the controllers that move a DDS220.
PREFIXES = {"kbd101": ("28",), "bbd30x": ("103",)}
_SETTLE_S = 0.05
# Long: a stall of the host is no failure of the port. Frames are a few bytes and never wait.
_WRITE_S = 2.0


class _Port(serial.Serial):
    """A local port whose ``write`` fails only while the port takes no bytes.

    That of pyserial fails also when the host stalls after all was written.
    """

    def write(self, data: Any, /) -> int:
        rest = bytes(data)
        while rest:
            try:
                rest = rest[os.write(self.fileno(), rest) :]
            except BlockingIOError:
                pass
            except OSError as error:
                raise serial.SerialException(f"write failed: {error}") from error
            if rest and not select.select([], [self.fileno()], [], _WRITE_S)[1]:
                raise serial.SerialTimeoutException("Write timeout")
        return len(data)


def find_port(controller: str, serial_number: str = "") -> str:
    """Return the device name of the port with this USB serial number, or of the only fitting one.

    Raises ``DeviceGoneError`` when none is there. Raises ``DeviceError`` when several fit.
    """
    ports = [port for port in list_ports.comports() if port.serial_number]
    if serial_number:
        fitting = [port for port in ports if port.serial_number == serial_number]
        which = f"with USB serial number {serial_number}"
    else:
        fitting = [
            port for port in ports if str(port.serial_number).startswith(PREFIXES[controller])
        ]
        which = f"of a {controller}"
    if not fitting:
        found = ", ".join(f"{port.device} ({port.serial_number})" for port in ports) or "none"
        raise DeviceGoneError(
            f"stage: no serial port {which}; USB serial ports found: {found}; check power and "
            "cable, or give the parameter port"
        )
    if len(fitting) > 1:
        names = ", ".join(str(port.serial_number) for port in fitting)
        raise DeviceError(f"stage: {len(fitting)} controllers fit ({names}); give serial")
    return str(fitting[0].device)


def open_port(name: str) -> SerialPort:
    """Return the port ``name``, a device or a URL of pyserial, opened for this process alone.

    Raises ``DeviceGoneError`` when there is no such port. Raises ``DeviceError`` when access is
    denied or another program holds it.
    """
    try:
        make = serial.serial_for_url if "://" in name else _Port
        port = make(
            name, BAUD, rtscts=True, exclusive=True, timeout=_SETTLE_S, write_timeout=_WRITE_S
        )
    except (serial.SerialException, OSError, ValueError) as error:
        raise _refusal(name, error) from error
    try:
        # A pseudo terminal has neither a latency timer nor lines.
        with contextlib.suppress(AttributeError, OSError, ValueError, NotImplementedError):
            port.set_low_latency_mode(True)
        time.sleep(_SETTLE_S)
        port.reset_input_buffer()
        port.reset_output_buffer()
        time.sleep(_SETTLE_S)
        with contextlib.suppress(OSError):
            port.rts = True
    except (serial.SerialException, OSError) as error:
        port.close()
        raise _refusal(name, error) from error
    return port


def _refusal(name: str, error: Exception) -> DeviceError:
    number = getattr(error, "errno", None)
    text = " ".join(str(error).split())
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return DeviceGoneError(f"stage: no port {name}; check power and cable")
    if number == errno.EACCES or "Permission denied" in text:
        return DeviceError(
            f"stage: {name} may not be opened; add the user to the group dialout and log in again"
        )
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in text or "busy" in text:
        return DeviceError(f"stage: another program holds {name}; close it")
    return DeviceError(f"stage: {name} cannot be opened: {text}; check the parameter port")
