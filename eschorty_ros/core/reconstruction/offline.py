"""The reconstruction of a recording."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.reconstruction.profiles import Profiles, place
from eschorty_ros.core.reconstruction.reconstructor import Reconstructor
from eschorty_ros.core.reconstruction.recording_warnings import recording_warnings
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.storage import Recording, height_map
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.core.storage.recording import SETTINGS_FILE

# Bytes of the file that are mapped at a time, in one thread and in several.
_PASS_BYTES = 1 << 20
_WINDOWS_BYTES = 1 << 26
_SPEED_SAMPLES = 256
_MOVING_SHARE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Points and profiles of a recording.

    Attributes
    ----------
    points : ndarray of POINT_DTYPE
        In ``eschorty_base``; ``t`` in seconds since the first event.
    profiles : Profiles
        The same points before placing, with their rows and times.
    counters : dict
        The reconstructor's, and ``points_without_stage``.
    profile_count, events : int
    periods_per_profile : int
    seconds : float
        Wall time of reconstruction and placing, reading of the file included.
    warnings : tuple of str
        One line each.
    organized : ndarray of POINT_DTYPE, shape (profiles, columns), or None
        ``points`` as a height map, with the setting ``organized``.
    """

    points: NDArray[np.void]
    profiles: Profiles
    counters: dict[str, int]
    profile_count: int
    periods_per_profile: int
    events: int
    seconds: float
    warnings: tuple[str, ...]
    organized: NDArray[np.void] | None = None

    @property
    def events_per_second(self) -> float:
        """Events over wall time."""
        return self.events / self.seconds if self.seconds > 0.0 else 0.0


def reconstruct_recording(
    recording: Recording,
    settings: Settings | None = None,
    progress: Callable[[int, int], Any] | None = None,
    jobs: int | None = None,
) -> Result:
    """Return the points of a recording, placed along the stage's travel.

    Parameters
    ----------
    recording : Recording
    settings : Settings, optional
        Those of the recorded scan when left out; ``stage_speed_mm_s`` is taken from the stage's
        samples instead.
    progress : callable, optional
        Called with bytes read so far and bytes in all.
    jobs : int, optional
        Threads; one per core at hand when left out. The points do not depend on it.

    Returns
    -------
    Result

    Raises
    ------
    FormatError
        When the event file is not EVT3.
    """
    began = time.perf_counter()
    settings = settings or recorded_settings(recording)
    settings = replace(settings, stage_speed_mm_s=stage_speed_mm_s(recording))
    jobs = len(os.sched_getaffinity(0)) if jobs is None else jobs
    reconstructor = Reconstructor(recording.calibration, recording.modulation, settings, jobs)
    total = recording.events_path.stat().st_size
    reader = RawReader(recording.events_path)
    placed = _Placed(recording)
    done = 0
    for chunk in reader.mapped(_WINDOWS_BYTES if jobs > 1 else _PASS_BYTES):
        for found in _pushed(reconstructor, chunk, done, recording.marks):
            placed.add(found)
        done += len(chunk)
        if progress is not None:
            progress(done, total)
    placed.add(reconstructor.flush())
    profiles, position = placed.joined()
    origin_us = reconstructor.first_t_us or 0
    points = place(
        profiles, reconstructor.model, position, recording.calibration.stage_direction, origin_us
    )
    organized = None
    if settings.organized == "on":
        organized = height_map(points, profiles.edge_us, reconstructor.model.columns)
    newest_us = reconstructor.newest_t_us
    span_us = None if newest_us is None else (origin_us, newest_us)
    seconds = time.perf_counter() - began
    counters = reconstructor.counters
    counters["points_without_stage"] = placed.without_stage
    used = replace(settings, periods_per_profile=reconstructor.periods_per_profile)
    warnings = [str(line) for line in reader.warnings] + reconstructor.warnings
    return Result(
        points,
        profiles,
        counters,
        profiles.profile_count,
        reconstructor.periods_per_profile,
        counters["events"],
        seconds,
        (*warnings, *recording_warnings(recording, used, counters, points, span_us)),
        organized,
    )


class _Placed:
    """Profiles with the stage's position at each point, those outside the scan left out."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._parts: list[tuple[Profiles, NDArray[np.float64]]] = []
        self.without_stage = 0

    def add(self, profiles: Profiles) -> None:
        """Append profiles."""
        position = self._recording.stage.position_mm(profiles.t_us)
        known = np.isfinite(position)
        self.without_stage += int(known.size - known.sum())
        if self._recording.scan is not None:
            known &= self._recording.scan.between(position)
        if not known.all():
            profiles, position = profiles.select(known), position[known]
        if len(profiles):
            self._parts.append((profiles, position))

    def joined(self) -> tuple[Profiles, NDArray[np.float64]]:
        """Return all profiles and positions, and free the parts of an array when it is copied."""
        parts, self._parts = self._parts, []
        if not parts:
            return Profiles.empty(), np.empty(0)
        position = np.concatenate([position for _, position in parts])
        arrays: dict[str, Any] = {
            item.name: [getattr(profiles, item.name) for profiles, _ in parts]
            for item in fields(Profiles)
        }
        parts.clear()
        return Profiles(**{name: _joined(arrays.pop(name)) for name in list(arrays)}), position


def _joined(parts: list[Any]) -> Any:
    """Return the parts of an array as one; they are ``None`` where it is not estimated."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if known else None


def recorded_settings(recording: Recording) -> Settings:
    """Return the settings of the recorded scan, the defaults where the recording has none.

    Raises
    ------
    FormatError
        When the recording's settings are not those of a reconstruction.
    """
    known = {item.name for item in fields(Settings)}
    unknown = sorted(str(name) for name in recording.settings.keys() - known)
    file = recording.path / SETTINGS_FILE
    if unknown:
        raise FormatError(f"{file}: {short(unknown[0])} is no setting; remove it")
    try:
        return Settings(**recording.settings)
    except ArgumentError as error:
        raise FormatError(f"{file}: {error}") from error


def _pushed(
    reconstructor: Reconstructor, chunk: memoryview, begin: int, marks: NDArray[np.void]
) -> Iterator[Profiles]:
    """Push a chunk that begins at a byte of the stream, with what the marks in it say."""
    first, last = np.searchsorted(marks["byte"], (begin, begin + len(chunk)))
    at = 0
    for byte, lost, laser_on in marks[first:last].tolist():
        yield reconstructor.push(chunk[at : byte - begin])
        at = byte - begin
        if lost:
            reconstructor.note_gap()
        if laser_on:
            reconstructor.restart_phase()
    yield reconstructor.push(chunk[at:])


def stage_speed_mm_s(recording: Recording) -> float:
    """Return the stage's median speed towards +y while it cruises; 0 when it rests."""
    first_us, last_us = recording.stage.first_us, recording.stage.last_us
    if first_us is None or last_us is None or last_us == first_us:
        return 0.0
    t_us = np.linspace(first_us, last_us, _SPEED_SAMPLES).astype(np.int64)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.diff(recording.stage.position_mm(t_us)) / np.diff(t_us) * 1e6
    speed = speed[np.isfinite(speed)]
    moving = np.abs(speed) > _MOVING_SHARE * np.abs(speed).max(initial=0.0)
    if not moving.any():
        return 0.0
    return float(np.median(speed[moving])) * recording.calibration.stage_direction[1]
