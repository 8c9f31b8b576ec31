"""Prophesee EVK4: events, settings, and a stream that restarts after the cable was unplugged.

Two threads while streaming: one receives and reconnects, one polls the camera's health.
Unconfirmed on hardware.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import usb.backend

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError, EschortyError
from eschorty_ros.hardware.base.protocols import DeviceIdentity, EventChunk
from eschorty_ros.hardware.camera.bulk_reader import ClockNs, lost_transfers
from eschorty_ros.hardware.camera.camera_usb import NAME
from eschorty_ros.hardware.camera.chunk_queue import BYTES_MAX, ChunkQueue
from eschorty_ros.hardware.camera.connection import Connection, EndedError
from eschorty_ros.hardware.camera.health import HealthMonitor
from eschorty_ros.hardware.camera.imx636 import HEIGHT, WIDTH
from eschorty_ros.hardware.camera.pixel_selection import Window
from eschorty_ros.hardware.camera.registers import Sleep
from eschorty_ros.hardware.camera.session import Session
from eschorty_ros.hardware.camera.settings import CameraSettings

_READ_S = 0.05
_STUCK_S = 1.0
_JOIN_S = 1.0


class Evk4:
    """Event source over one EVK4; thread-safe.

    A failed transfer (a stall, an overflow) is cleared once and reported as a gap. The driver
    reconnects after a second one in a row, when neither events nor answers come, when the camera
    has stopped streaming by itself and after an unplugged cable: it releases the camera, waits,
    searches for the same serial, initialises it, writes its settings and streams. The stream then
    restarts (``EventChunk.restarted``).

    - ``clock_ns``: Clock of the arrival times.
    - ``serial``: Hex serial, ``""`` for the only camera. After a loss only the same camera is
      opened again.
    - ``reconnect_attempts``: Searches for a lost camera: after 0.5 s, then with waits doubling up
      to 8 s.
    - ``queue_bytes``: Bytes that may wait to be read; more is dropped, counted and reported as a
      gap.
    - ``sleep``: Replaces all waits, for tests.
    """

    width = WIDTH
    height = HEIGHT

    def __init__(
        self,
        backend: usb.backend.IBackend,
        clock_ns: ClockNs,
        serial: str = "",
        settings: CameraSettings | None = None,
        reconnect_attempts: int = 6,
        queue_bytes: int = BYTES_MAX,
        sleep: Sleep | None = None,
    ) -> None:
        self.on_loss: Callable[[str], None] = lambda _line: None
        self._connection = Connection(
            backend,
            clock_ns,
            serial,
            settings or CameraSettings(),
            reconnect_attempts,
            self._wait,
            sleep or time.sleep,
        )
        self._sleep = sleep
        self._queue = ChunkQueue(queue_bytes)
        self._health = HealthMonitor(self._streaming_session)
        self._ending = threading.Event()
        self._closed = False
        self._thread: threading.Thread | None = None
        self._hung: threading.Thread | None = None
        self._last_loop_s = 0.0
        self._failed_transfers = 0

    @property
    def identity(self) -> DeviceIdentity:
        """Return model, serial and firmware; complete after ``open``."""
        return self._connection.identity

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return one line for each oddity that ``open`` found."""
        session = self._connection.session
        return session.warnings if session is not None else ()

    @property
    def loss(self) -> str:
        """Return why a streaming camera is searched for, one line; empty while it is there."""
        return self._connection.loss if self._thread is not None else ""

    @property
    def healthy(self) -> bool:
        """Return whether the receiving thread runs and the camera answers."""
        thread = self._thread
        return (
            thread is not None
            and thread.is_alive()
            and not self._ending.is_set()
            and self._connection.session is not None
            and time.monotonic() - self._last_loop_s < _STUCK_S
            and self._health.answering
        )

    def open(self) -> None:
        """Find, initialise and set up the camera: 2.6 s; ``close`` interrupts it.

        Raises ``DeviceError`` when no camera, or not the one with this serial, can be opened.
        """
        self._refuse_closed()
        self._ending.clear()
        self._connection.open()

    def start(self) -> None:
        """Start streaming; sensor time starts at 0.

        Raises ``DeviceError`` when closed or the camera fails.
        """
        self._refuse_closed()
        if self._thread is not None:
            return
        if self._hung is not None and self._hung.is_alive():
            raise DeviceError(
                f"{NAME} {self.identity.serial}: its last reads have not ended; configure it again"
            )
        self.open()
        self._queue.open()
        self._connection.require("start").start()
        self._last_loop_s = time.monotonic()
        self._thread = threading.Thread(target=self._receive, name="EVK4 events", daemon=True)
        self._thread.start()
        self._health.start()

    def read(self, timeout_s: float) -> EventChunk | None:
        """Return the next chunk, ``None`` when none came in ``timeout_s``.

        Raises ``DeviceError`` when closed, or the camera was lost and did not come back.
        """
        self._refuse_closed()
        return self._queue.get(timeout_s)

    def stop(self) -> None:
        """End streaming; idempotent.

        Raises ``DeviceError`` when the camera fails, or the receiving thread hangs; ``close`` is
        then needed.
        """
        self._ending.set()
        self._health.stop()
        thread, self._thread = self._thread, None
        self._queue.close()
        if thread is None:
            return
        try:
            session = self._connection.session
            if session is not None:
                session.stop_sensor()
        finally:
            thread.join(_JOIN_S)
            # The thread may just have started another one.
            session = self._connection.session
            if session is not None:
                try:
                    session.stop_sensor()
                finally:
                    session.reader.stop()
        if thread.is_alive():
            # A second thread would share its reads.
            self._hung = thread
            raise DeviceError(
                f"{NAME} {self.identity.serial}: its reads do not end; configure it again"
            )

    def close(self) -> None:
        """Stop, power down, release; idempotent, never raises."""
        self._closed = True
        session = self._connection.session
        if session is not None:
            session.shorten_timeouts()
        try:
            self.stop()
        except EschortyError as error:
            self._connection.drop(DeviceError(f"closing: {error}"))
        self._connection.close()

    def set_bias(self, name: str, offset: int) -> int:
        """Set one bias; returns the offset the camera reads back.

        Raises ``ArgumentError`` for an unknown bias or an offset outside its range. Raises
        ``DeviceError`` when the camera is not open or reads back another value.
        """
        settings = self._connection.settings
        settings = replace(settings, biases={**settings.biases, name: offset})
        kept = self._connection.require(name).set_bias(name, offset)
        self._connection.settings = settings
        return kept

    def set_windows(self, windows: Sequence[Window]) -> None:
        """Set the regions of interest: first column, first row, width, height; none is all.

        Raises ``DeviceError`` when the camera is not open or does not answer.
        """
        self._connection.require("roi").set_windows(windows)
        self._connection.settings = replace(self._connection.settings, windows=tuple(windows))

    def filters_out(self, frequency_hz: float) -> bool:
        """Return whether the anti-flicker filter removes light modulated at ``frequency_hz``."""
        band = self._connection.settings.anti_flicker
        return band is not None and band.erases(frequency_hz)

    def read_biases(self) -> dict[str, int]:
        """Return the offsets in the camera; raises ``DeviceError`` when it is not open."""
        return self._connection.require("biases").read_biases()

    def statistics(self) -> dict[str, float]:
        """Return counters and readings for diagnostics, by name with unit."""
        connection, queue = self._connection, self._queue
        session = connection.session
        values: dict[str, float] = {
            "bytes": queue.received_bytes,
            "queue_bytes": queue.waiting_bytes,
            "dropped_bytes": queue.dropped_bytes,
            "drops": queue.drops,
            "gaps": queue.gaps,
            "restarts": queue.restarts,
            "failed_transfers": self._failed_transfers,
            "lost_transfers": lost_transfers(),
            "losses": connection.losses,
            "reconnects": connection.reconnects,
            "reconnect_attempts": connection.attempts,
            "temperature_c": self._health.temperature_c,
            "health_failures": self._health.failures,
        }
        if session is not None:
            values["control_requests"] = session.control.requests
            values["control_recoveries"] = session.control.recoveries
            values |= session.applied
        return {name: float(value) for name, value in values.items()}

    def _refuse_closed(self) -> None:
        if self._closed:
            raise DeviceError(f"{NAME} {self.identity.serial} is closed; open it again")

    def _streaming_session(self) -> Session | None:
        session = self._connection.session
        return session if session is not None and session.streaming else None

    def _wait(self, seconds: float) -> None:
        """Wait; raises ``EndedError`` on ``stop`` and ``close``."""
        if self._sleep is not None and not self._ending.is_set():
            self._sleep(seconds)
        elif self._ending.wait(seconds):
            raise EndedError(f"{NAME} was closed before it was ready")

    def _receive(self) -> None:
        failed_before = False
        try:
            while not self._ending.is_set():
                self._last_loop_s = time.monotonic()
                try:
                    failed_before = self._receive_once(failed_before)
                except DeviceError as error:
                    if not self._ending.is_set():
                        self._reconnect(error)
        except EndedError:
            return
        except DeviceError as error:
            self._queue.fail(error)
        except Exception as error:
            self._queue.fail(DeviceError(f"{NAME}: receiving it failed: {error!r}"))

    def _receive_once(self, failed_before: bool) -> bool:
        """Receive one transfer; returns whether it failed, raises when the camera is lost."""
        session = self._connection.require("events")
        self._health.raise_failure()
        try:
            data, arrival_ns = session.reader.read(_READ_S)
        except DeviceError as error:
            self._failed_transfers += 1
            self._queue.mark_gap()
            if failed_before or isinstance(error, DeviceGoneError):
                raise
            session.reader.resume()
            return True
        if not data:
            return failed_before
        self._health.note_streaming()
        self._queue.put(data, arrival_ns)
        return False

    def _reconnect(self, error: DeviceError) -> None:
        self._connection.drop(error)
        self.on_loss(self._connection.loss)
        self._connection.reopen(self._restart)
        self._health.note_streaming()

    def _restart(self, session: Session) -> None:
        self._queue.mark_restart()
        session.start()
