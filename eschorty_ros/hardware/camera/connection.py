"""The connection to one camera: opened, and opened again after a loss."""

from __future__ import annotations

import threading
from collections.abc import Callable

import usb.backend

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.hardware.base.protocols import DeviceIdentity
from eschorty_ros.hardware.camera.bulk_reader import ClockNs
from eschorty_ros.hardware.camera.camera_usb import NAME
from eschorty_ros.hardware.camera.registers import Sleep
from eschorty_ros.hardware.camera.session import Session
from eschorty_ros.hardware.camera.settings import CameraSettings

_FIRST_WAIT_S = 0.5
_LONGEST_WAIT_S = 8.0


class EndedError(DeviceError):
    """A wait that the end of the stream cut short."""


class Connection:
    """Session of one camera; thread-safe.

    - ``serial``: ``""`` for the only camera. After the first opening only the same camera is opened
      again.
    - ``settings``: Written in every new session.
    - ``attempts_max``: Searches for a lost camera.
    - ``sleep``: Waits some seconds; raises :class:`EndedError` when the stream ends.
    - ``settle``: Waits milliseconds, always to the end.

    Public attributes:
    - ``session``: The open camera.
    - ``loss``: Reason of the loss, one line; empty while there is a session.
    """

    def __init__(
        self,
        backend: usb.backend.IBackend,
        clock_ns: ClockNs,
        serial: str,
        settings: CameraSettings,
        attempts_max: int,
        sleep: Sleep,
        settle: Sleep,
    ) -> None:
        self.session: Session | None = None
        self.identity = DeviceIdentity("Prophesee EVK4", serial)
        self.settings = settings
        self.loss = ""
        self.losses = self.reconnects = self.attempts = 0
        self._backend = backend
        self._clock_ns = clock_ns
        self._attempts_max = attempts_max
        self._sleep = sleep
        self._settle = settle
        self._lock = threading.Lock()
        self._closed = False

    def require(self, what: str) -> Session:
        """Return the session; raises ``DeviceError``, which names ``what``, without one."""
        session = self.session
        if session is None:
            raise DeviceError(f"{what}: the camera is not open; try again when it is back")
        return session

    def open(self) -> None:
        """Open a session unless there is one; raises ``DeviceError``."""
        if self.session is not None:
            return
        session = Session(
            self._backend,
            self.identity.serial,
            self.settings,
            self._clock_ns,
            self._sleep,
            self._settle,
        )
        with self._lock:
            if not self._closed:
                self.session = session
                self.identity = session.identity
                self.loss = ""
                return
        session.close()
        raise EndedError(f"{NAME} was closed before it was ready")

    def drop(self, error: DeviceError) -> None:
        """Release a camera that failed."""
        self.losses += 1
        self.loss = str(error)
        self._release(gone=True)

    def reopen(self, start: Callable[[Session], None]) -> None:
        """Open the same camera again and ``start`` it.

        Raises ``EndedError`` when the stream ends before. Raises ``DeviceGoneError`` after the last
        attempt.
        """
        last = self.loss
        wait_s = _FIRST_WAIT_S
        for _ in range(self._attempts_max):
            self._sleep(wait_s)
            wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)
            self.attempts += 1
            try:
                self.open()
                start(self.require("stream"))
            except EndedError:
                raise
            except DeviceError as error:
                last = self.loss = str(error)
                self._release(gone=True)
                continue
            self.reconnects += 1
            return
        raise DeviceGoneError(
            f"{NAME} {self.identity.serial}: lost, and not back after "
            f"{self._attempts_max} attempts ({last}); check cable and power, then "
            "configure it again"
        )

    def close(self) -> None:
        """Power down and release, for good; never raises."""
        with self._lock:
            self._closed = True
        self._release(gone=False)

    def _release(self, gone: bool) -> None:
        with self._lock:
            session, self.session = self.session, None
        if session is not None:
            session.close(gone=gone)
