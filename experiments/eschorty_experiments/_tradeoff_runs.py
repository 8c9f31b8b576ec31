"""The settings and scenes of the trade-off, and the measures of time, memory and error."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

from eschorty_experiments._scan_errors import ScanErrors, scan_errors
from eschorty_ros.core.line import CENTROIDS
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, load_calibration
from eschorty_ros.core.reconstruction import NOISE_FILTERS, Profiles, Reconstructor, Settings
from eschorty_ros.core.reconstruction import paper_method as reference
from eschorty_ros.core.storage import Recording
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.simulation.scenes import Scene, named
from eschorty_ros.simulation.world import simulate_recording

SCENES = ("plane", "steps", "leaves")
BACKGROUND_SHARES = (0.0, 0.05, 0.3)
FREQUENCY_HZ = 70.0
SPEED_MM_S = 300.0
GATE_US = 1000
DEFAULT = Settings()
SMOOTHING = 0, 2, DEFAULT.smoothing_half_width
BASELINE = "numpy baseline"

_CHUNK_BYTES = 1 << 20
_COLUMNS_EVERY = 8


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to turn bytes into profiles; without settings it is the numpy baseline."""

    settings: Settings | None

    @property
    def estimator(self) -> str:
        """Name of the column estimator."""
        return self.settings.centroid if self.settings else BASELINE

    @property
    def filters(self) -> str:
        """Filters in front of the estimator."""
        return filters_of(self.settings) if self.settings else "none"

    @property
    def half_width(self) -> int:
        """Columns averaged on either side."""
        return self.settings.smoothing_half_width if self.settings else 0

    @property
    def label(self) -> str:
        """Estimator, filters and smoothing in words."""
        if self.settings is None:
            return self.estimator
        return f"{self.estimator}, filter {self.filters}, smoothing {self.half_width}"

    @property
    def is_default(self) -> bool:
        """True for the default settings."""
        return self.settings == DEFAULT

    def run(self, data: bytes, recording: Recording) -> Profiles:
        """Return the profiles of a stream."""
        if self.settings is None:
            model = recording.calibration.model()
            events = reference.decode_all(data)
            return reference.reconstruct(*events, model, recording.modulation)
        reconstructor = Reconstructor(recording.calibration, recording.modulation, self.settings)
        parts = [
            reconstructor.push(data[k : k + _CHUNK_BYTES])
            for k in range(0, len(data), _CHUNK_BYTES)
        ]
        return Profiles.concatenate([*parts, reconstructor.flush()])


def filters_of(settings: Settings) -> str:
    """Return the names of the filters of ``settings``."""
    names = [] if settings.noise_filter == "none" else [settings.noise_filter]
    return " + ".join([*names, "gate"] if settings.phase_gate_us > 0 else names) or "none"


def variants() -> list[Variant]:
    """Return the baseline, then every estimator with every filter and smoothing."""
    return [Variant(None)] + [
        Variant(
            replace(
                DEFAULT,
                centroid=method,
                noise_filter=noise_filter,
                phase_gate_us=gate_us,
                smoothing_half_width=half_width,
            )
        )
        for method, noise_filter, gate_us, half_width in product(
            CENTROIDS, NOISE_FILTERS, (DEFAULT.phase_gate_us, GATE_US), SMOOTHING
        )
    ]


def one_change() -> list[Variant]:
    """Return baseline, default, and the variants that differ from it in one setting."""
    kept = []
    for variant in variants()[1:]:
        same = (
            variant.estimator == DEFAULT.centroid,
            variant.filters == filters_of(DEFAULT),
            variant.half_width == DEFAULT.smoothing_half_width,
        )
        if sum(same) >= len(same) - 1:
            kept.append(variant)
    return [Variant(None), *sorted(kept, key=lambda variant: not variant.is_default)]


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Events of one scene and background, in memory."""

    scene_name: str
    background_share: float
    scene: Scene
    recording: Recording
    data: bytes
    events: int
    periods: int


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A variant on a stream."""

    variant: Variant
    stream: Stream
    seconds: float
    peak_bytes: float
    errors: ScanErrors


def record_streams(
    travel_mm: tuple[float, float], columns: int, seed: int, note: Callable[[str], None]
) -> list[Stream]:
    """Record every scene with every background, on the columns in the middle of the line."""
    streams = []
    calibration = replace(load_calibration("config_3"), columns=columns, principal_column=None)
    for name in SCENES:
        scene = named(name)
        note(f"simulating {name}")
        noiseless = _record(name, scene, 0.0, 0.0, calibration, travel_mm, seed)
        streams.append(noiseless)
        model = noiseless.recording.calibration.model()
        t_us = noiseless.recording.stage_samples["t_us"]
        pixel_seconds = model.columns * model.rows * float(t_us[-1] - t_us[0]) * 1e-6
        for share in BACKGROUND_SHARES:
            if share:
                rate_hz = noiseless.events * share / (1.0 - share) / pixel_seconds
                streams.append(_record(name, scene, share, rate_hz, calibration, travel_mm, seed))
    return streams


def _record(
    name: str,
    scene: Scene,
    share: float,
    background_hz: float,
    calibration: Calibration,
    travel_mm: tuple[float, float],
    seed: int,
) -> Stream:
    with TemporaryDirectory(prefix="eschorty_") as folder:
        recording = simulate_recording(
            Path(folder),
            scene,
            calibration,
            Modulation(FREQUENCY_HZ),
            *travel_mm,
            SPEED_MM_S,
            seed,
            background_hz,
        )
        data = b"".join(RawReader(recording.events_path).chunks(_CHUNK_BYTES))
        # The truth is read from the file on first access, before the folder is deleted.
        assert recording.truth is not None
        reconstructor = Reconstructor(recording.calibration, recording.modulation)
        reconstructor.push(data)
        reconstructor.flush()
        counters = reconstructor.counters
    return Stream(
        name, share, scene, recording, data, counters["events"], counters["periods_closed"]
    )


def measure(variant: Variant, stream: Stream, repeats: int, with_memory: bool) -> Measured:
    """Measure the shortest CPU time of some repeats, the errors, and optionally the peak memory.

    The time is from EVT3 bytes in memory to profiles with ranges. The memory is the most that
    Python and numpy allocate meanwhile (tracemalloc), without the bytes themselves.
    """
    seconds = float("inf")
    profiles = Profiles.empty()
    for _ in range(repeats):
        began = time.process_time()
        profiles = variant.run(stream.data, stream.recording)
        seconds = min(seconds, time.process_time() - began)
    peak = peak_bytes(lambda: variant.run(stream.data, stream.recording)) if with_memory else None
    errors = scan_errors(profiles, stream.recording, stream.scene, _COLUMNS_EVERY)
    return Measured(variant, stream, seconds, float("nan") if peak is None else peak, errors)


def peak_bytes(task: Callable[[], object]) -> int:
    """Return the most bytes that Python and numpy allocate during ``task`` beyond those before."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        task()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
