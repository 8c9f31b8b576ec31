"""The reconstruction of a recording."""

from __future__ import annotations

import math
import mmap
import os
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.clocks import SPEED_LIMIT_MM_S
from eschorty_ros.core.optics import refuse_other_sensor
from eschorty_ros.core.reconstruction.clock_wraps import in_wrap
from eschorty_ros.core.reconstruction.pass_lag import PassLag, pass_lag, take_off_lag
from eschorty_ros.core.reconstruction.profiles import Profiles, place
from eschorty_ros.core.reconstruction.reconstructor import Reconstructor
from eschorty_ros.core.reconstruction.recording_warnings import recording_warnings, shown_modulation
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.reconstruction.windows import JOBS_MAX
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE, Recording, height_map
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.core.storage.recording import SETTINGS_FILE, STAGE_FILE, TRUTH_FILE, between

# Bytes of the file that are mapped at a time, in one thread and in several.
_PASS_BYTES = 1 << 20
_WINDOWS_BYTES = 1 << 27
# Profiles that wait to be placed.
_WAITING = 4
_SPEED_SAMPLES = 256
_MOVING_SHARE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Points and profiles of a recording."""

    points: NDArray[np.void]
    """POINT_DTYPE, with the setting ``reflectance`` REFLECTANCE_DTYPE, in ``eschorty_base``; ``t``
    in seconds since the first event."""
    profiles: Profiles
    """The same points before placing, with their rows and times; none where the points are in a
    file and the recording has no truth to compare them with."""
    counters: dict[str, int]
    """The reconstructor's, and ``points_without_stage`` and ``points_outside_scan``."""
    profile_count: int
    periods_per_profile: int
    events: int
    seconds: float
    """Wall time from the file to placed points and warnings."""
    warnings: tuple[str, ...]
    """One line each."""
    organized: NDArray[np.void] | None = None
    """``points`` as a height map, shape (profiles, columns), with the setting ``organized``."""
    pass_lag: PassLag | None = None
    """What has been taken off times and places of the points, which passes back and forth show."""

    @property
    def events_per_second(self) -> float:
        """Events over wall time."""
        return self.events / self.seconds if self.seconds > 0.0 else 0.0


def reconstruct_recording(
    recording: Recording,
    settings: Settings | None = None,
    progress: Callable[[int, int], Any] | None = None,
    jobs: int | None = None,
    folder: Path | None = None,
) -> Result:
    """Return the points of a recording, placed along the stage's travel.

    - ``settings``: Those of the recorded scan when left out; ``stage_speed_mm_s`` is taken from the
      stage's samples instead.
    - ``progress``: Called with bytes read so far and bytes in all.
    - ``jobs``: Threads; one per core at hand when left out. The points do not depend on it.
    - ``folder``: Where the points are written while the recording is read; the result's are maps of
      files there, and the memory does not grow with the recording. In memory when left out.

    Raises ``FormatError`` when the event file is not EVT3 or the stage is too fast, and
    ``CalibrationError`` when the calibration is of another sensor.
    """
    began = time.perf_counter()
    settings = settings or recorded_settings(recording)
    reader = RawReader(recording.events_path)
    name, build = recording.events_path.name, recording.calibration
    refuse_other_sensor(name, *reader.header.named_size, build)
    recording, wrapped = in_wrap(recording)
    settings = replace(settings, stage_speed_mm_s=stage_speed_mm_s(recording))
    jobs = min(len(os.sched_getaffinity(0)), JOBS_MAX) if jobs is None else jobs
    reconstructor = Reconstructor(recording.calibration, recording.modulation, settings, jobs)
    total = recording.events_path.stat().st_size
    done = 0
    with ExitStack() as files, ThreadPoolExecutor(1) as beside:
        pending = beside.submit(shown_modulation, recording) if jobs > 1 else None
        cloud = _Cloud(recording, reconstructor, folder, files)
        add = _InTurn(beside if jobs > 1 else None, cloud.add)
        for chunk in reader.mapped(_WINDOWS_BYTES if jobs > 1 else _PASS_BYTES):
            _push(reconstructor, add, chunk, done, recording.marks)
            done += len(chunk)
            if progress is not None:
                progress(done, total)
        add(reconstructor.flush())
        add.wait()
        profiles, points, organized = cloud.joined()
    origin_us = reconstructor.first_t_us or 0
    direction = recording.calibration.stage_direction
    lag = pass_lag(points, origin_us, recording.stage, direction)
    if lag is not None:
        for part in (points,) if organized is None else (points, organized.reshape(-1)):
            take_off_lag(part, origin_us, recording.stage, direction, lag.lag_us)
        profiles = replace(profiles, t_us=profiles.t_us - round(lag.lag_us))
    newest_us = reconstructor.newest_t_us
    span_us = None if newest_us is None else (origin_us, newest_us)
    counters = reconstructor.counters
    counters["points_without_stage"] = cloud.without_stage
    counters["points_outside_scan"] = cloud.outside_scan
    used = replace(settings, periods_per_profile=reconstructor.periods_per_profile)
    shown = shown_modulation(recording) if pending is None else pending.result()
    warnings = (
        *map(str, reader.warnings),
        *wrapped,
        *recording_warnings(
            recording, used, counters, points, span_us, shown, reconstructor.warnings
        ),
    )
    return Result(
        points=points,
        profiles=profiles,
        counters=counters,
        profile_count=cloud.profile_count,
        periods_per_profile=reconstructor.periods_per_profile,
        events=counters["events"],
        seconds=time.perf_counter() - began,
        warnings=warnings,
        organized=organized,
        pass_lag=lag,
    )


class _InTurn:
    """Calls a function with one argument after the other, in the thread of a pool if there is one.

    At most `_WAITING` calls wait.
    """

    def __init__(self, pool: ThreadPoolExecutor | None, call: Callable[[Any], Any]) -> None:
        self._pool, self._call = pool, call
        self._calls: deque[Future[Any]] = deque()

    def __call__(self, argument: Any) -> None:
        if self._pool is None:
            self._call(argument)
            return
        self._calls.append(self._pool.submit(self._call, argument))
        self.wait(_WAITING)

    def wait(self, most: int = 0) -> None:
        """Wait until at most so many calls are left; raise what one of them has raised."""
        while len(self._calls) > most:
            self._calls.popleft().result()


class _Joined(NamedTuple):
    """All profiles and points of a recording, and the height map where it is made."""

    profiles: Profiles
    points: NDArray[np.void]
    organized: NDArray[np.void] | None


class _Cloud:
    """Profiles placed along the stage's travel, those outside the scan left out."""

    def __init__(
        self,
        recording: Recording,
        reconstructor: Reconstructor,
        folder: Path | None,
        files: ExitStack,
    ) -> None:
        self._recording, self._reconstructor = recording, reconstructor
        self._profiles: list[Profiles] = []
        self._keeps_profiles = folder is None or (recording.path / TRUTH_FILE).exists()
        self._points = _Array(folder and folder / "points", files)
        self._organized: _Array | None = None
        if reconstructor.settings.organized == "on":
            self._organized = _Array(folder and folder / "organized", files)
        self._newest_edge_us: int | None = None
        self.profile_count = 0
        self.without_stage = self.outside_scan = 0

    def add(self, profiles: Profiles) -> None:
        """Append complete profiles."""
        recording, model = self._recording, self._reconstructor.model
        position = recording.stage.position_mm(profiles.t_us)
        known = np.isfinite(position)
        self.without_stage += int(known.size - known.sum())
        if recording.scan is not None:
            inside = between(position, recording.scan.start_mm, recording.scan.stop_mm)
            self.outside_scan += int((known & ~inside).sum())
            known &= inside
        if not known.all():
            profiles, position = profiles.select(known), position[known]
        if not len(profiles):
            return
        self.profile_count += profiles.profile_count
        self.profile_count -= int(profiles.edge_us[0]) == self._newest_edge_us
        self._newest_edge_us = int(profiles.edge_us[-1])
        origin_us = self._reconstructor.first_t_us or 0
        direction = recording.calibration.stage_direction
        points = place(profiles, model, position, direction, origin_us)
        self._points.append(points)
        if self._organized is not None:
            self._organized.append(height_map(points, profiles.edge_us, model.columns))
        if self._keeps_profiles:
            self._profiles.append(profiles)

    def joined(self) -> _Joined:
        """Return all profiles, points and the height map; free the parts while they are copied."""
        none = np.empty(
            0,
            REFLECTANCE_DTYPE if self._reconstructor.settings.reflectance == "on" else POINT_DTYPE,
        )
        points = self._points.joined(none)
        organized = None
        if self._organized is not None:
            organized = self._organized.joined(none.reshape(0, self._reconstructor.model.columns))
        parts, self._profiles = self._profiles, []
        if not parts:
            return _Joined(Profiles.empty(), points, organized)
        arrays: dict[str, Any] = {
            item.name: [getattr(profiles, item.name) for profiles in parts]
            for item in fields(Profiles)
        }
        parts.clear()
        profiles = Profiles(**{name: _joined(arrays.pop(name)) for name in list(arrays)})
        return _Joined(profiles, points, organized)


class _Array:
    """An array that grows along its first axis, in memory or in a file."""

    def __init__(self, file: Path | None, files: ExitStack) -> None:
        self._parts: list[NDArray[Any]] = []
        self._stream = None if file is None else files.enter_context(file.open("x+b"))

    def append(self, part: NDArray[Any]) -> None:
        """Append a part."""
        if self._stream is None:
            self._parts.append(part)
        else:
            self._stream.write(part.data)

    def joined(self, none: NDArray[Any]) -> NDArray[Any]:
        """Return all parts as one array, or ``none`` of them; it has dtype and shape of a part."""
        if self._stream is None:
            parts, self._parts = self._parts, []
            return np.concatenate(parts) if parts else none
        if not self._stream.tell():
            return none
        self._stream.flush()
        data = mmap.mmap(self._stream.fileno(), 0)
        return np.frombuffer(data, none.dtype).reshape(-1, *none.shape[1:])


def _joined(parts: list[Any]) -> Any:
    """Return the parts of an array as one; they are ``None`` where it is not estimated."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if known else None


def recorded_settings(recording: Recording) -> Settings:
    """Return the settings of the recorded scan, the defaults where the recording has none.

    Raises ``FormatError`` when the recording's settings are not those of a reconstruction.
    """
    settings = Settings.from_file(recording.settings, recording.path / SETTINGS_FILE)
    return settings.allowed(recording.modulation)


def _push(
    reconstructor: Reconstructor,
    each: Callable[[Profiles], Any],
    chunk: memoryview,
    begin: int,
    marks: NDArray[np.void],
) -> None:
    """Push a chunk that begins at a byte of the stream, with the marks in it."""
    first, last = np.searchsorted(marks["byte"], (begin, begin + len(chunk)))
    at = 0
    for byte, lost, laser_on in marks[first:last].tolist():
        reconstructor.push_to(each, chunk[at : byte - begin])
        at = byte - begin
        if lost:
            reconstructor.note_gap()
        if laser_on:
            reconstructor.restart_phase()
    reconstructor.push_to(each, chunk[at:])


def stage_speed_mm_s(recording: Recording) -> float:
    """Return the speed of a recorded scan, or else the stage's median speed while it cruises.

    It is 0 when the stage rests or has gaps alone, and positive where the first pass is towards +y.
    Raises ``FormatError`` for more than ``SPEED_LIMIT_MM_S``.
    """
    scan = recording.scan
    if scan is not None and scan.speed_mm_s:
        return math.copysign(scan.speed_mm_s, scan.stop_mm - scan.start_mm)
    first_us, last_us = recording.stage.first_us, recording.stage.last_us
    if first_us is None or last_us is None or last_us == first_us:
        return 0.0
    t_us = np.linspace(first_us, last_us, _SPEED_SAMPLES).astype(np.int64)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.diff(recording.stage.position_mm(t_us)) / np.diff(t_us) * 1e6
    # A sample that is wrong makes two intervals with a speed that the stage does not have.
    known = speed[np.isfinite(speed)]
    if not known.size:
        return 0.0
    near = np.pad(known, 2, mode="edge")
    speed = np.median(np.lib.stride_tricks.sliding_window_view(near, 5), axis=1)
    cruising = speed[np.abs(speed) > _MOVING_SHARE * np.abs(speed).max(initial=0.0)]
    if not cruising.size:
        return 0.0
    along_mm_s = math.copysign(float(np.median(np.abs(cruising))), cruising[0])
    if abs(along_mm_s) > SPEED_LIMIT_MM_S:
        raise FormatError(
            f"{recording.path / STAGE_FILE}: the stage moves at {abs(along_mm_s) * 1e-3:.3g} m/s; "
            "write t_us in microseconds and position_mm in millimetres"
        )
    return along_mm_s * recording.calibration.stage_direction[1]
