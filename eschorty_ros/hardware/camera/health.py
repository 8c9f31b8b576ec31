"""Health of a streaming camera: its state while no events come, and its temperature."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.hardware.camera.session import Session

_QUIET_S = 0.1
_ANSWER_TIMEOUT_S = 0.5
_TEMPERATURE_EVERY_S = 5.0
_TICK_S = 0.03
_JOIN_S = 0.5


class HealthMonitor:
    """Polls the camera in a thread of its own, so that a late answer delays no events.

    - ``session``: Returns the streaming session, ``None`` without one.

    Public attributes:
    - ``temperature_c``: Last reading; NaN before the first and after a failed one.
    - ``failures``: Requests without an answer.
    """

    def __init__(self, session: Callable[[], Session | None]) -> None:
        self.temperature_c = math.nan
        self.failures = 0
        self._session = session
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._quiet_at_s = time.monotonic() + _QUIET_S
        self._requested_s: float | None = None
        self._failure: DeviceError | None = None

    def start(self) -> None:
        """Start polling."""
        self.note_streaming()
        # One flag per thread: one that still waits for an answer must not go on with the next one.
        ending = self._ending = threading.Event()
        self._thread = threading.Thread(
            target=self._run, args=(ending,), name="EVK4 health", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop polling; idempotent."""
        self._ending.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_JOIN_S)

    @property
    def answering(self) -> bool:
        """Return whether no request has waited for its answer for 0.5 s.

        A request that a busy host sends late does not count against the camera.
        """
        requested_s = self._requested_s
        return requested_s is None or time.monotonic() - requested_s < _ANSWER_TIMEOUT_S

    def note_streaming(self) -> None:
        """Record that the camera sent events or was opened."""
        self._quiet_at_s = time.monotonic() + _QUIET_S
        self._failure = None

    def raise_failure(self) -> None:
        """Raise the ``DeviceError`` of the last check, once."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _check_streaming(self) -> None:
        """Request the state of a camera without events: without light it sends none."""
        session = self._session()
        if session is None:
            return
        self._requested_s = time.monotonic()
        try:
            if session.is_streaming():
                self._quiet_at_s = time.monotonic() + _QUIET_S
                return
            failure = DeviceError(
                "camera: it has stopped streaming by itself (reset or power dip); check its power"
            )
        except DeviceError as error:
            self.failures += 1
            failure = error
        finally:
            self._requested_s = None
        # The answer does not hold for a camera that was opened in the meantime.
        if self._session() is session:
            self._failure = failure

    def _read_temperature(self) -> None:
        session = self._session()
        if session is None:
            self.temperature_c = math.nan
            return
        try:
            self.temperature_c = session.temperature_c()
        except DeviceError:
            self.temperature_c = math.nan
            self.failures += 1

    def _run(self, ending: threading.Event) -> None:
        measured_s = -math.inf
        while not ending.wait(max(self._quiet_at_s - time.monotonic(), _TICK_S)):
            now_s = time.monotonic()
            if now_s > self._quiet_at_s:
                self._check_streaming()
            elif now_s - measured_s > _TEMPERATURE_EVERY_S:
                measured_s = now_s
                self._read_temperature()
