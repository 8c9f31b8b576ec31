"""EVK4 through the package ``neuromorphic-drivers``: an alternative to this project's own driver.

Its ring buffer is filled in Rust, off the interpreter's lock. It has no filters, no packet period
(4 ms), no windows, and does not reconnect. Version 0.18; unconfirmed on hardware.
"""

from __future__ import annotations

import math
import threading
from typing import Any

from eschorty_ros.core.errors import ArgumentError, DeviceError
from eschorty_ros.hardware.camera.bulk_reader import ClockNs
from eschorty_ros.hardware.camera.camera_usb import same_serial
from eschorty_ros.hardware.camera.chunk_queue import ChunkQueue
from eschorty_ros.hardware.camera.event_rate import PERIOD_US
from eschorty_ros.hardware.camera.imx636 import HEIGHT, WIDTH
from eschorty_ros.hardware.camera.settings import CameraSettings
from eschorty_ros.hardware.protocols import DeviceIdentity, EventChunk

NAME = "EVK4 camera (neuromorphic-drivers)"
_WAIT_S = 0.02


class NeuromorphicEvk4:
    """Event source over ``neuromorphic_drivers`` in raw mode.

    Parameters
    ----------
    clock_ns : callable
        Clock of the arrival times.
    serial : str
        Hex serial; ``""`` takes the first camera.
    settings : CameraSettings, optional

    Raises
    ------
    ArgumentError
        For settings the package does not offer.
    """

    width = WIDTH
    height = HEIGHT
    warnings = (f"{NAME}: its packet period is 4 ms, mipi_frame_period is not used",)
    trouble = ""

    def __init__(
        self, clock_ns: ClockNs, serial: str = "", settings: CameraSettings | None = None
    ) -> None:
        self.identity = DeviceIdentity("Prophesee EVK4", serial)
        self.settings = settings or CameraSettings()
        _refuse_unsupported(self.settings)
        self._clock_ns = clock_ns
        self._queue = ChunkQueue()
        self._device: Any = None
        self._lock = threading.Lock()
        self._streaming = False
        self._backlog = 0

    @property
    def healthy(self) -> bool:
        """Whether it streams."""
        return self._streaming

    def open(self) -> None:
        """Find and initialise the camera.

        Raises
        ------
        DeviceError
            When the package or the camera is not there.
        """
        drivers = _package()
        serial = _find(drivers, self.identity.serial)
        try:
            self._device = drivers.open(
                configuration=self._configuration(drivers),
                iterator_timeout=_WAIT_S,
                raw=True,
                serial=serial,
            )
        except Exception as error:
            raise DeviceError(
                f"{NAME} {serial}: it cannot be opened ({_line(error)}); check the udev rule and "
                "close other programs"
            ) from error
        self.identity = DeviceIdentity("Prophesee EVK4", serial)

    def start(self) -> None:
        """Begin to hand out events; what came since ``open`` is thrown away."""
        if self._device is None:
            self.open()
        self._device.clear_backlog(0)
        self._queue.open()
        self._streaming = True

    def read(self, timeout_s: float) -> EventChunk | None:
        """Take what arrived next, ``None`` when nothing came.

        Raises
        ------
        DeviceError
            When closed or the camera was lost.
        """
        with self._lock:
            if self._device is None:
                raise DeviceError(f"{NAME} {self.identity.serial} is closed; open it again")
            if not self._streaming:
                return None
            try:
                status, data = next(self._device)
            except Exception as error:
                self._streaming = False
                raise DeviceError(
                    f"{NAME} {self.identity.serial}: lost ({_line(error)}); check cable and "
                    "power, then configure it again"
                ) from error
        if status.ring is None or not data:
            return None
        self._backlog = status.ring.backlog
        if status.ring.overflow_indices or status.ring.dropped_packets:
            self._queue.mark_gap()
        delay_ns = round((status.delay() or 0.0) * 1e9)
        self._queue.put(bytes(data), self._clock_ns() - delay_ns)
        return self._queue.get(0.0)

    def stop(self) -> None:
        """Hand out no more; idempotent."""
        self._streaming = False
        self._queue.close()

    def close(self) -> None:
        """Release the camera; idempotent, never raises."""
        self.stop()
        with self._lock:
            device, self._device = self._device, None
        if device is not None:
            device.close()

    def set_bias(self, name: str, offset: int) -> int:
        """Set one bias; the package cannot read it back, so it returns what was asked.

        Raises
        ------
        ArgumentError
            For an unknown bias or an offset outside its range.
        DeviceError
            When the camera is not there.
        """
        settings = self.settings.with_bias(name, offset)
        if self._device is None:
            raise DeviceError(f"{name}: the camera is not open; try again when it is back")
        self.settings = settings
        self._device.update_configuration(self._configuration(_package()))
        return offset

    def read_biases(self) -> dict[str, int]:
        """Offsets as they were set."""
        return dict(self.settings.biases)

    def statistics(self) -> dict[str, float]:
        """Counters and readings for diagnostics, by name with unit."""
        queue = self._queue
        return {
            "bytes": float(queue.received_bytes),
            "gaps": float(queue.gaps),
            "restarts": float(queue.restarts),
            "backlog_packets": float(self._backlog),
            "temperature_c": self._temperature_c(),
        }

    def _temperature_c(self) -> float:
        device = self._device
        try:
            return float(device.temperature_celsius()) if device is not None else math.nan
        except RuntimeError:
            return math.nan

    def _configuration(self, drivers: Any) -> Any:
        evk4 = drivers.prophesee_evk4
        biases = {
            name.removeprefix("bias_"): offset for name, offset in self.settings.biases.items()
        }
        rate = self.settings.erc_rate
        return evk4.Configuration(
            biases=evk4.Biases(**biases),
            enable_external_trigger=self.settings.trigger_input,
            rate_limiter=None
            if rate is None
            else evk4.RateLimiter(PERIOD_US, rate * PERIOD_US // 1_000_000),
        )


def _package() -> Any:
    try:
        import neuromorphic_drivers
    except ImportError as error:
        raise DeviceError(
            "driver neuromorphic needs the package neuromorphic-drivers; "
            "pip install neuromorphic-drivers, or use driver evk4"
        ) from error
    return neuromorphic_drivers


def _find(drivers: Any, serial: str) -> str:
    """Find the serial of the EVK4 to open, as the package writes it."""
    try:
        listed = drivers.list_devices()
    except RuntimeError as error:
        # Without /dev/bus/usb the package's list fails instead of being empty.
        raise DeviceError(
            f"{NAME}: the USB bus cannot be listed ({_line(error)}); plug the camera in, and give "
            "this machine access to /dev/bus/usb"
        ) from error
    cameras = [device for device in listed if device.name is drivers.Name.PROPHESEE_EVK4]
    for camera in cameras:
        if camera.serial is not None and (not serial or same_serial(camera.serial, serial)):
            return str(camera.serial)
    there = ", ".join(camera.serial or f"one with {camera.error}" for camera in cameras)
    raise DeviceError(
        f"{NAME}: none{f' with serial {serial}' if serial else ''} can be opened, there is "
        f"{there or 'no camera'}; check cable, power, udev rule and serial"
    )


def _refuse_unsupported(settings: CameraSettings) -> None:
    unsupported = {
        "roi": settings.windows,
        "hot_pixels": settings.hot_pixels,
        "trail_filter": settings.trail_filter,
        "anti_flicker": settings.anti_flicker,
    }
    for name, value in unsupported.items():
        if value:
            raise ArgumentError(f"{name} is set and driver neuromorphic has none; use driver evk4")


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
