"""One opened EVK4, from claim to release, without reconnection and without threads.

The order of the steps is openeb 5.1.1's. Unconfirmed on hardware.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from contextlib import suppress

import usb.backend

from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.hardware.base.protocols import DeviceIdentity
from eschorty_ros.hardware.camera import event_rate, imx636, monitors, treuzell
from eschorty_ros.hardware.camera.biases import BiasBank
from eschorty_ros.hardware.camera.bulk_reader import BulkReader, ClockNs, make_reader
from eschorty_ros.hardware.camera.camera_usb import NAME, open_camera, read_serial
from eschorty_ros.hardware.camera.pixel_selection import Window, set_windows
from eschorty_ros.hardware.camera.registers import Sleep, run_sequence
from eschorty_ros.hardware.camera.settings import CameraSettings, apply_settings

_FIRMWARE_OLDEST = 0x030800


class Session:
    """A camera, initialised and set up; stopped until ``start``.

    - ``serial``: Hex serial number, ``""`` for the only camera.
    - ``clock_ns``: Clock of the arrival times.
    - ``sleep``: Waits some seconds; may raise to end the opening.
    - ``settle``: Waits milliseconds, always to the end.

    Public attributes:
    - ``warnings``: One line each.
    - ``applied``: Settings as read back.
    - ``reader``: For one thread.
    - ``streaming``: True from ``start`` to ``stop_sensor``.

    Raises ``DeviceError`` when it cannot be opened, is no IMX636 or refuses its settings; nothing
    stays open then.
    """

    def __init__(
        self,
        backend: usb.backend.IBackend,
        serial: str,
        settings: CameraSettings,
        clock_ns: ClockNs,
        sleep: Sleep,
        settle: Sleep,
    ) -> None:
        self._sleep = sleep
        self._settle = settle
        self._usb = open_camera(backend, serial)
        self.control = treuzell.Treuzell(self._usb)
        self.streaming = False
        # Sequences and read-modify-write accesses must not be interleaved.
        self._sequence = threading.RLock()
        self.warnings: tuple[str, ...] = ()
        try:
            self.identity = self._identify()
            self._initialise()
            self._biases = BiasBank(self.control)
            self.applied = apply_settings(self.control, self._biases, settings)
            self.reader: BulkReader = make_reader(
                backend, self._usb.device, self._usb.endpoints.data_in, clock_ns
            )
        except BaseException:
            # Ctrl-C may arrive in the 2.5 s of the initialisation.
            self._usb.close()
            raise

    def start(self) -> None:
        """Queue the reads, then start the sensor; its time starts at 0."""
        self.reader.start()
        with self._sequence:
            run_sequence(self.control, imx636.START, self._sleep)
            self.streaming = True

    def stop_sensor(self) -> None:
        """Stop the sensor; the reads go on."""
        with self._sequence:
            if self.streaming:
                self.streaming = False
                run_sequence(self.control, imx636.STOP, self._settle)

    def is_streaming(self) -> bool:
        """Return whether the sensor's time base runs."""
        return imx636.is_streaming(self.control)

    def temperature_c(self) -> float:
        """Return the temperature of the sensor (C)."""
        with self._sequence:
            return monitors.read_temperature_c(self.control, self._settle)

    def set_bias(self, name: str, offset: int) -> int:
        """Set one bias; returns the offset the camera reads back."""
        with self._sequence:
            kept = self._biases.write(name, offset)
        self.applied[name] = kept
        return kept

    def set_windows(self, windows: Sequence[Window]) -> None:
        """Set the regions of interest."""
        with self._sequence:
            set_windows(self.control, windows)

    def read_biases(self) -> dict[str, int]:
        """Return the offsets in the camera."""
        return self._biases.read()

    def shorten_timeouts(self) -> None:
        """Wait less for answers from now on, because the camera is being closed."""
        self.control.retries = False
        self._usb.shorten_timeouts()

    def close(self, *, gone: bool = False) -> None:
        """Power the sensor down unless it is ``gone``, and release it; never raises."""
        self.shorten_timeouts()
        with suppress(EschortyError):
            if not gone:
                self.stop_sensor()
                with self._sequence:
                    monitors.end_monitors(self.control, self._settle)
                    run_sequence(self.control, imx636.DESTROY, self._settle)
        self.reader.stop()
        self._usb.close()

    def _identify(self) -> DeviceIdentity:
        serial = read_serial(self.control)
        payload = self.control.request(treuzell.FIRMWARE)
        if len(payload) < 4:
            raise DeviceError(
                f"{NAME} {serial}: its firmware version has {len(payload)} bytes, not 4; "
                "update the camera"
            )
        version = struct.unpack_from("<I", payload)[0]
        text = _version_text(version)
        if version < _FIRMWARE_OLDEST:
            raise DeviceError(
                f"{NAME} {serial}: its firmware is {text}, {_version_text(_FIRMWARE_OLDEST)} is "
                "the oldest supported; update it with the maker's tool"
            )
        devices = self.control.request(treuzell.DEVICE_COUNT)
        if len(devices) < 4 or struct.unpack_from("<I", devices)[0] < 1:
            raise DeviceError(f"{NAME} {serial}: it reports no sensor; power-cycle it")
        if self._usb.slow:
            self.warnings += (
                f"{NAME} {serial}: the link is slower than USB 3 (5 Gbit/s); use a blue port and "
                "the camera's own cable",
            )
        return DeviceIdentity("Prophesee EVK4", serial, text)

    def _initialise(self) -> None:
        if not imx636.is_imx636(self.control):
            raise DeviceError(
                f"{NAME} {self.identity.serial}: its sensor does not answer as an IMX636 "
                f"(register 0014 reads {self.control.read(imx636.CHIP_ID):08X}); power-cycle it"
            )
        run_sequence(self.control, imx636.STOP + imx636.DESTROY + imx636.INIT, self._sleep)
        monitors.begin_monitors(self.control, self._sleep)
        event_rate.initialise(self.control)


def _version_text(version: int) -> str:
    return f"{version >> 16 & 0xFF}.{version >> 8 & 0xFF}.{version & 0xFF}"
