"""The emulated bench in this process, with a clock that tests set."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from waiting import wait_until

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.emulation.bench.devices import Bench, BenchSettings
from eschorty_ros.emulation.bus import EmulatedBackend
from eschorty_ros.hardware.camera import CameraSettings, Evk4

MS = 1_000_000
COLUMNS = 64


class StillBench:
    """A camera of few columns before a white plane at rest; ``folder`` gets its calibration."""

    def __init__(self, folder: Path) -> None:
        build = replace(
            load_calibration("config_3"), columns=COLUMNS, principal_column=(COLUMNS - 1) / 2
        )
        path = folder / "build.yaml"
        save_calibration(build, path)
        self._now_ns = 5_000 * MS
        self.bench = Bench(
            BenchSettings("plane", str(path), background_hz=0.0, trigger="none"), self.clock_ns
        )
        self.backend = EmulatedBackend(self.bench.usb_devices)

    def clock_ns(self) -> int:
        return self._now_ns

    def light(self, frequency_hz: float) -> None:
        self.bench.physics.set_laser(self._now_ns, True, Modulation(frequency_hz))

    def statistic(self, name: str) -> int:
        return int(self.bench.physics.statistics()[name])

    def run(self, duration_ms: int, arrived: Callable[[], int]) -> None:
        """Advance the time; returns when as many events have ``arrived`` as left the sensor."""
        self._now_ns += duration_ms * MS

        def complete() -> bool:
            counts = self.bench.physics.statistics()
            return counts["behind_s"] < 4e-3 and arrived() == counts["events"]

        wait_until(complete, "every event", poll_s=1e-3)


class CameraOnBench(StillBench):
    """The same with the EVK4 driver and a decoder; ``times_us`` are of all events so far."""

    def __init__(self, folder: Path, settings: CameraSettings | None = None) -> None:
        super().__init__(folder)
        self.camera = Evk4(self.backend, self.clock_ns, settings=settings, sleep=lambda _s: None)
        self.decoder = Decoder()
        self.times_us: list[int] = []
        self._polarities: list[int] = []

    def __enter__(self) -> CameraOnBench:
        self.camera.open()
        self.camera.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self.camera.close()

    def counts(self, duration_ms: int) -> NDArray[np.int64]:
        """Advance the time; returns the OFF and ON events that arrived meanwhile."""
        before = len(self._polarities)
        self.run(duration_ms, self._read)
        return np.bincount(self._polarities[before:], minlength=2)

    def _read(self) -> int:
        while (chunk := self.camera.read(0.0)) is not None:
            events = self.decoder.decode(chunk.data)
            self.times_us += events.t.tolist()
            self._polarities += events.p.tolist()
        return len(self.times_us)
