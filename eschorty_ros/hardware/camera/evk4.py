"""Prophesee EVK4: events, settings, and a stream that comes back after the cable did.

Two threads while streaming: one receives (and reconnects), one looks after the camera's health.
Unconfirmed on hardware.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import usb.backend

from eschorty_ros.core.errors import (
    DeviceError,
    DeviceGoneError,
    DeviceStallError,
    EschortyError,
)
from eschorty_ros.hardware.camera.bulk_reader import ClockNs
from eschorty_ros.hardware.camera.camera_usb import NAME
from eschorty_ros.hardware.camera.chunk_queue import BYTES_MAX, ChunkQueue
from eschorty_ros.hardware.camera.health import Health
from eschorty_ros.hardware.camera.imx636 import HEIGHT, WIDTH
from eschorty_ros.hardware.camera.registers import Sleep
from eschorty_ros.hardware.camera.session import Session
from eschorty_ros.hardware.camera.settings import CameraSettings
from eschorty_ros.hardware.protocols import DeviceIdentity, EventChunk

_READ_S = 0.1
_JOIN_S = 1.5


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


@dataclass
class _Counts:
    stalls: int = 0
    errors: int = 0
    losses: int = 0
    reconnects: int = 0
    attempts: int = 0
    last_loss: str = field(default="")


class _EndedError(DeviceError):
    """A wait that ``stop`` or ``close`` cut short."""


class Evk4:
    """Event source over one EVK4; thread-safe.

    A stalled data endpoint is cleared once and a gap reported; a second stall in a row, silence
    of both endpoints, and every other error make it reconnect: release, wait, look for the same
    serial, initialise, set up, stream. The stream then begins anew (``EventChunk.restarted``).

    Parameters
    ----------
    backend : usb.backend.IBackend
    clock_ns : callable
        Clock of the arrival times.
    serial : str
        Hex serial; ``""`` takes the only camera there is, and sticks to it.
    settings : CameraSettings, optional
    reconnection : Reconnection, optional
    queue_bytes : int
        Bytes that may wait to be read; more is dropped, counted and reported as a gap.
    sleep : callable, optional
        Waits some seconds in place of real time, for tests.
    on_loss : callable, optional
        Called with one line from the receiving thread when the camera was lost.

    Attributes
    ----------
    identity : DeviceIdentity
        Model, serial, firmware; known after ``open``.
    """

    width = WIDTH
    height = HEIGHT

    def __init__(
        self,
        backend: usb.backend.IBackend,
        clock_ns: ClockNs,
        serial: str = "",
        settings: CameraSettings | None = None,
        reconnection: Reconnection | None = None,
        queue_bytes: int = BYTES_MAX,
        sleep: Sleep | None = None,
        on_loss: Callable[[str], None] | None = None,
    ) -> None:
        self.identity = DeviceIdentity("Prophesee EVK4", serial)
        self._backend = backend
        self._clock_ns = clock_ns
        self._settings = settings or CameraSettings()
        self._reconnection = reconnection or Reconnection()
        self._sleep = sleep or time.sleep
        self._real_time = sleep is None
        self._on_loss = on_loss or (lambda _line: None)
        self._queue = ChunkQueue(queue_bytes)
        self._session: Session | None = None
        self._session_lock = threading.RLock()
        self._ending = threading.Event()
        self._closed = False
        self._thread: threading.Thread | None = None
        self._health = Health(self._healthy_session)
        self._counts = _Counts()

    @property
    def settings(self) -> CameraSettings:
        """Settings as asked for."""
        return self._settings

    @property
    def applied(self) -> dict[str, float]:
        """Settings as the camera has them."""
        session = self._session
        return dict(session.applied) if session is not None else {}

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line each about the camera as it was opened."""
        session = self._session
        return session.warnings if session is not None else ()

    @property
    def reconnecting(self) -> str:
        """Why the camera is being looked for; empty while it is there."""
        return self._counts.last_loss if self._lost else ""

    def open(self) -> None:
        """Find, initialise and set up the camera: 2.6 s; ``close`` cuts it short.

        Raises
        ------
        DeviceError
            In one line.
        """
        self._refuse_closed()
        self._ending.clear()
        self._new_session()

    def start(self) -> None:
        """Begin streaming; sensor time starts at 0.

        Raises
        ------
        DeviceError
            When closed or the camera fails.
        """
        self._refuse_closed()
        if self._thread is not None:
            return
        self._ending.clear()
        if self._session is None:
            self._new_session()
        assert self._session is not None
        self._queue.open()
        self._session.start()
        self._thread = threading.Thread(target=self._receive, name="EVK4 events", daemon=True)
        self._thread.start()
        self._health.start()

    def read(self, timeout_s: float) -> EventChunk | None:
        """Take what arrived next, ``None`` when nothing came in ``timeout_s``.

        Raises
        ------
        DeviceError
            When closed, or the camera was lost and did not come back.
        """
        self._refuse_closed()
        return self._queue.get(timeout_s)

    def stop(self) -> None:
        """End streaming; idempotent."""
        self._ending.set()
        self._health.stop()
        thread, self._thread = self._thread, None
        try:
            with self._session_lock:
                if self._session is not None and thread is not None and not self._lost:
                    self._session.stop()
        finally:
            self._queue.close()
            if thread is not None and thread is not threading.current_thread():
                thread.join(_JOIN_S)

    def close(self) -> None:
        """Stop, power down, release; idempotent, never raises."""
        self._closed = True
        try:
            self.stop()
        except EschortyError:
            self._lost = True
        with self._session_lock:
            session, self._session = self._session, None
            if session is not None:
                session.close(gone=self._lost)

    def set_bias(self, name: str, offset: int) -> int:
        """Set one bias; returns the offset the camera reads back.

        Raises
        ------
        ArgumentError
            For an unknown bias or an offset outside its range.
        DeviceError
            When the camera is not there or keeps another value.
        """
        settings = self._settings.with_bias(name, offset)
        session = self._healthy_session()
        if session is None:
            raise DeviceError(f"{name}: the camera is not open; try again when it is back")
        kept = session.biases.write(name, offset)
        self._settings = settings
        session.applied[name] = kept
        return kept

    def read_biases(self) -> dict[str, int]:
        """Offsets the camera has now.

        Raises
        ------
        DeviceError
            When it is not there.
        """
        session = self._healthy_session()
        if session is None:
            raise DeviceError("biases: the camera is not open; try again when it is back")
        return session.biases.read()

    def statistics(self) -> dict[str, float]:
        """Counters and readings for diagnostics, by name with unit."""
        session, queue, counts = self._session, self._queue, self._counts
        values: dict[str, float] = {
            "bytes": queue.received_bytes,
            "queue_bytes": queue.waiting_bytes,
            "dropped_bytes": queue.dropped_bytes,
            "drops": queue.drops,
            "gaps": queue.gaps,
            "restarts": queue.restarts,
            "stalls": counts.stalls,
            "transfer_errors": counts.errors,
            "losses": counts.losses,
            "reconnects": counts.reconnects,
            "reconnect_attempts": counts.attempts,
            "temperature_c": self._health.temperature_c,
            "health_failures": self._health.failures,
        }
        if session is not None:
            values["control_requests"] = session.control.requests
            values["control_recoveries"] = session.control.recoveries
            values |= session.applied
        return {name: float(value) for name, value in values.items()}

    _lost = False

    def _refuse_closed(self) -> None:
        if self._closed:
            raise DeviceError(f"{NAME} {self.identity.serial} is closed; open it again")

    def _pause(self, seconds: float) -> None:
        """Wait; ``stop`` and ``close`` cut it short."""
        if self._ending.is_set():
            raise _EndedError(f"{NAME} was closed before it was ready")
        if not self._real_time:
            self._sleep(seconds)
        elif self._ending.wait(seconds):
            raise _EndedError(f"{NAME} was closed before it was ready")

    def _healthy_session(self) -> Session | None:
        return None if self._lost else self._session

    def _new_session(self) -> None:
        session = Session(
            self._backend, self.identity.serial, self._settings, self._clock_ns, self._pause
        )
        with self._session_lock:
            if self._closed:
                session.close()
                raise _EndedError(f"{NAME} was closed before it was ready")
            self._session = session
            self.identity = session.identity
            self._lost = False

    def _receive(self) -> None:
        stalled = False
        try:
            while not self._ending.is_set():
                try:
                    stalled = self._receive_once(stalled)
                except DeviceError as error:
                    if self._ending.is_set():
                        return
                    self._reconnect(error)
        except _EndedError:
            return
        except DeviceError as error:
            self._queue.fail(error)

    def _receive_once(self, stalled: bool) -> bool:
        session = self._session
        assert session is not None
        self._health.check()
        try:
            data, arrival_ns = session.reader.read(_READ_S)
        except DeviceStallError:
            self._counts.stalls += 1
            self._queue.mark_gap()
            if stalled:
                raise
            session.reader.start()
            return True
        except DeviceGoneError:
            raise
        except DeviceError:
            self._counts.errors += 1
            self._queue.mark_gap()
            if stalled:
                raise
            session.reader.start()
            return True
        if data:
            self._health.heard()
            self._queue.put(data, arrival_ns)
            return False
        return stalled

    def _reconnect(self, error: DeviceError) -> None:
        """Get the same camera back and its stream going.

        Raises
        ------
        DeviceGoneError
            After the last attempt.
        """
        counts = self._counts
        counts.losses += 1
        counts.last_loss = str(error)
        with self._session_lock:
            self._lost = True
            session, self._session = self._session, None
        if session is not None:
            session.close(gone=True)
        self._on_loss(str(error))
        last = error
        for attempt in range(self._reconnection.attempts):
            self._pause(self._reconnection.wait_s(attempt))
            counts.attempts += 1
            try:
                self._new_session()
                assert self._session is not None
                self._queue.mark_restart()
                self._session.start()
            except _EndedError:
                raise
            except DeviceError as again:
                last = again
                self._discard()
                continue
            counts.reconnects += 1
            self._health.heard()
            return
        raise DeviceGoneError(
            f"{NAME} {self.identity.serial}: lost ({error}) and not back after "
            f"{self._reconnection.attempts} attempts (last: {last}); check cable and power, then "
            "configure it again"
        )

    def _discard(self) -> None:
        with self._session_lock:
            self._lost = True
            session, self._session = self._session, None
        if session is not None:
            session.close(gone=True)


def settings_with(settings: CameraSettings, **changes: Any) -> CameraSettings:
    """Make the settings with some fields changed."""
    return replace(settings, **changes)
