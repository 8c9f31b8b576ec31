"""Keeping one camera open: the first time, and again after it was lost."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import usb.backend

from eschorty_ros.core.errors import DeviceError, DeviceGoneError
from eschorty_ros.hardware.camera.bulk_reader import ClockNs
from eschorty_ros.hardware.camera.camera_usb import NAME
from eschorty_ros.hardware.camera.registers import Sleep
from eschorty_ros.hardware.camera.session import Session
from eschorty_ros.hardware.camera.settings import CameraSettings
from eschorty_ros.hardware.protocols import DeviceIdentity


class EndedError(DeviceError):
    """A wait that the end of the stream cut short."""


@dataclass(frozen=True, slots=True)
class Reconnection:
    """How often and how patiently a lost camera is looked for.

    Parameters
    ----------
    attempts : int
        0 gives up at once.
    first_s, longest_s : float
        Wait before the first attempt; it doubles up to the longest.
    """

    attempts: int = 6
    first_s: float = 0.5
    longest_s: float = 8.0

    def wait_s(self, attempt: int) -> float:
        """Wait before that attempt, counted from 0."""
        return min(self.first_s * 2.0**attempt, self.longest_s)


class Keeper:
    """Holds the session of one camera; thread-safe.

    Parameters
    ----------
    backend : usb.backend.IBackend
    clock_ns : callable
    serial : str
        ``""`` takes the only camera there is, and sticks to it.
    settings : CameraSettings
        What every new session is set up with.
    reconnection : Reconnection
    pause : callable
        Waits some seconds; raises :class:`EndedError` to give up.
    settle : callable
        Waits milliseconds to the end.

    Attributes
    ----------
    identity : DeviceIdentity
    settings : CameraSettings
    loss : str
        Why there is no session after one was lost, one line; empty otherwise.
    losses, reconnects, attempts : int
    """

    def __init__(
        self,
        backend: usb.backend.IBackend,
        clock_ns: ClockNs,
        serial: str,
        settings: CameraSettings,
        reconnection: Reconnection,
        pause: Sleep,
        settle: Sleep,
    ) -> None:
        self.identity = DeviceIdentity("Prophesee EVK4", serial)
        self.settings = settings
        self.loss = ""
        self.losses = self.reconnects = self.attempts = 0
        self._backend = backend
        self._clock_ns = clock_ns
        self._reconnection = reconnection
        self._pause = pause
        self._settle = settle
        self._session: Session | None = None
        self._lock = threading.Lock()
        self._closed = False

    @property
    def session(self) -> Session | None:
        """The open camera, ``None`` while there is none."""
        return self._session

    def require(self, what: str) -> Session:
        """Return the open camera.

        Raises
        ------
        DeviceError
            While there is none; names ``what`` was wanted.
        """
        session = self._session
        if session is None:
            raise DeviceError(f"{what}: the camera is not open; try again when it is back")
        return session

    def open(self) -> None:
        """Open a session unless there is one.

        Raises
        ------
        DeviceError
            In one line.
        """
        if self._session is not None:
            return
        session = Session(
            self._backend,
            self.identity.serial,
            self.settings,
            self._clock_ns,
            self._pause,
            self._settle,
        )
        with self._lock:
            if not self._closed:
                self._session = session
                self.identity = session.identity
                self.loss = ""
                return
        session.close()
        raise EndedError(f"{NAME} was closed before it was ready")

    def lose(self, error: DeviceError) -> None:
        """Release a camera that failed."""
        self.losses += 1
        self.loss = str(error)
        self._release(gone=True)

    def regain(self, begin: Callable[[Session], None]) -> None:
        """Get the same camera back and ``begin`` with it.

        Raises
        ------
        EndedError
            When the pause gives up.
        DeviceGoneError
            After the last attempt.
        """
        last = self.loss
        for attempt in range(self._reconnection.attempts):
            self._pause(self._reconnection.wait_s(attempt))
            self.attempts += 1
            try:
                self.open()
                begin(self.require("stream"))
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
            f"{self._reconnection.attempts} attempts ({last}); check cable and power, then "
            "configure it again"
        )

    def close(self) -> None:
        """Power down and release, for good; never raises."""
        with self._lock:
            self._closed = True
        self._release(gone=False)

    def _release(self, gone: bool) -> None:
        with self._lock:
            session, self._session = self._session, None
        if session is not None:
            session.close(gone=gone)
