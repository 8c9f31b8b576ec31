"""An emulated EVK4 with its driver, without sleeps and with events on demand."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np
from waiting import DEADLINE_S

from eschorty_ros.emulation.bus import EmulatedBackend
from eschorty_ros.emulation.evk4 import BoardIdentity, Evk4Model
from eschorty_ros.hardware.base.protocols import EventChunk
from eschorty_ros.hardware.camera import Evk4

SERIAL = 0x00051234


def milliseconds(first: int, count: int) -> bytes:
    """Return EVT3 of one event per millisecond of sensor time: column 5, row ms modulo 720."""
    words = []
    for ms in range(first, first + count):
        t_us = 1000 * ms
        words += [0x8000 | t_us >> 12 & 0xFFF, 0x6000 | t_us & 0xFFF, ms % 720, 0x2805]
    return np.array(words, "<u2").tobytes()


class OnDemand:
    """A source of the events that a test gives; sensor time starts at 0 with every start."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting = b""
        self._ms = 0
        self.running = False
        self.starts = 0

    def start(self) -> None:
        with self._changed:
            self.running = True
            self.starts += 1
            self._ms = 0
            self._waiting = b""

    def stop(self) -> None:
        with self._changed:
            self.running = False
            self._changed.notify_all()

    def give(self, count: int) -> bytes:
        """Add ``count`` milliseconds of events; returns their bytes."""
        with self._changed:
            data = milliseconds(self._ms, count)
            self._ms += count
            self._waiting += data
            self._changed.notify_all()
        return data

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        with self._changed:
            if not self._waiting:
                self._changed.wait(timeout_s)
            data, self._waiting = self._waiting[:max_bytes], self._waiting[max_bytes:]
            return data


_BUSES: dict[str, list[Evk4Model]] = {}


def backend(name: str) -> EmulatedBackend:
    """Return the bus of that name, for the parameter ``evk4_bench:backend?name``."""
    return EmulatedBackend(lambda: _BUSES.get(name, []))


def plug(name: str, *models: Evk4Model) -> None:
    _BUSES[name] = list(models)


class CameraBench:
    """A model with a driver; ``attempts`` None searches for a lost camera without end."""

    def __init__(self, *, attempts: int | None = 5, serial: int = SERIAL, **options: Any) -> None:
        self.source = OnDemand()
        board = BoardIdentity(serial=serial)
        self.model = Evk4Model(self.source, board=board, wait=lambda *_: False)
        self.bus = [self.model]
        self.backend = EmulatedBackend(lambda: self.bus)
        self.losses: list[str] = []
        self.slept: list[float] = []
        self.camera = self.driver(attempts=attempts, **options)
        self.chunks: list[EventChunk] = []

    def driver(self, *, attempts: int | None = 5, **options: Any) -> Evk4:
        options.setdefault("sleep", self._sleep)
        attempts = sys.maxsize if attempts is None else attempts
        camera = Evk4(self.backend, time.monotonic_ns, reconnect_attempts=attempts, **options)
        camera.on_loss = self.losses.append
        return camera

    def _sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        # Let the test's thread run.
        time.sleep(min(seconds, 1e-3))

    def streaming(self) -> CameraBench:
        self.camera.open()
        self.camera.start()
        return self

    def read(self, count: int) -> bytes:
        """Read at least ``count`` bytes; returns all bytes of these reads."""
        data = b""
        end_s = time.monotonic() + DEADLINE_S
        while len(data) < count:
            assert time.monotonic() < end_s, f"{len(data)} of {count} bytes came"
            chunk = self.camera.read(0.1)
            if chunk is not None:
                self.chunks.append(chunk)
                data += chunk.data
        return data

    def exchange(self, count: int = 20) -> None:
        """Give events and read exactly their bytes."""
        given = self.source.give(count)
        assert self.read(len(given)) == given

    def count(self, name: str) -> int:
        return int(self.camera.statistics()[name])

    def __enter__(self) -> CameraBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.camera.close()
