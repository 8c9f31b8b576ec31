"""Looking after a camera while it streams: its temperature, and whether silence is darkness."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Protocol

from eschorty_ros.core.errors import DeviceError

SILENCE_S = 0.1
PATIENCE_S = 0.5
TEMPERATURE_EVERY_S = 5.0
_TURN_S = 0.03
_JOIN_S = 0.5


class Patient(Protocol):
    """What can be asked of a camera beside its stream."""

    def temperature_c(self) -> float:
        """Temperature (C)."""

    def is_streaming(self) -> bool:
        """Whether the sensor runs."""


class Health:
    """Asks a camera how it is, in a thread of its own: an answer that is late delays no events.

    Parameters
    ----------
    patient : callable
        The camera, ``None`` while there is none.

    Attributes
    ----------
    temperature_c : float
        Last reading; NaN before the first and when it failed.
    failures : int
        Questions without an answer.
    """

    def __init__(self, patient: Callable[[], Patient | None]) -> None:
        self.temperature_c = math.nan
        self.failures = 0
        self._patient = patient
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._heard_s = time.monotonic()
        self._asked_s: float | None = None
        self._finding: DeviceError | None = None

    def start(self) -> None:
        """Begin to look."""
        self._ending.clear()
        self.heard()
        self._thread = threading.Thread(target=self._look, name="EVK4 health", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End it; idempotent."""
        self._ending.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_JOIN_S)

    @property
    def alive(self) -> bool:
        """Whether no question has been waiting for its answer for 0.5 s.

        A busy host that asks late is no dead camera; one that does not answer is.
        """
        asked_s = self._asked_s
        return asked_s is None or time.monotonic() - asked_s < PATIENCE_S

    def heard(self) -> None:
        """Take note that events came: the camera lives."""
        self._heard_s = time.monotonic()
        self._finding = None

    def check(self) -> None:
        """Raise the ``DeviceError`` that was found, once."""
        finding, self._finding = self._finding, None
        if finding is not None:
            raise finding

    def examine(self) -> None:
        """Ask a silent camera whether it still streams: in the dark it is silent too."""
        patient = self._patient()
        if patient is None:
            return
        self._asked_s = time.monotonic()
        try:
            if patient.is_streaming():
                self._heard_s = time.monotonic()
                return
            finding = DeviceError(
                "camera: it has stopped streaming by itself (reset or power dip); check its power"
            )
        except DeviceError as error:
            self.failures += 1
            finding = error
        finally:
            self._asked_s = None
        # Not about a camera that was replaced while it was asked.
        if self._patient() is patient:
            self._finding = finding

    def measure(self) -> None:
        """Read the temperature."""
        patient = self._patient()
        if patient is None:
            self.temperature_c = math.nan
            return
        try:
            self.temperature_c = patient.temperature_c()
        except DeviceError:
            self.temperature_c = math.nan
            self.failures += 1

    def _look(self) -> None:
        measured_s = -math.inf
        while not self._ending.wait(_TURN_S):
            now_s = time.monotonic()
            if now_s - self._heard_s > SILENCE_S:
                self.examine()
            elif now_s - measured_s > TEMPERATURE_EVERY_S:
                measured_s = now_s
                self.measure()
