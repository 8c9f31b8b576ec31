"""The steps of a scan: on every way out the laser goes off, the stage rests, points are kept."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ
from eschorty_ros.core.storage import EVENTS_FILE
from eschorty_ros.live.sweep_coverage import COMPLETE, PASSES_MAX

_FAILED_DRAIN_S = 5.0
# Longest time for the end of a scan on a computer that falls behind.
_DRAIN_S = 1800.0
SPEED_MIN_MM_S = 0.05
"""Least speed of a scan or move: between two statuses a slower stage seems to rest."""


class ScanFailure(EschortyError):  # noqa: N818 - reported like the other failures
    """A scan that cannot continue; the message begins with the component that failed."""


class ScanCanceled(Exception):  # noqa: N818 - a request, not an error
    """The client canceled the scan."""


class End(Enum):
    """End of a sequence."""

    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """A scan's parameters; ``frequency_hz`` or ``duty`` 0 keeps the laser's setting.

    Every second one of ``passes`` sweeps goes back.
    """

    scan_id: str
    start_mm: float
    stop_mm: float
    speed_mm_s: float
    frequency_hz: float = 0.0
    duty: float = 0.0
    passes: int = 1

    @property
    def last_mm(self) -> float:
        """Return where the last pass ends."""
        return self.stop_mm if self.passes % 2 else self.start_mm


@dataclass(frozen=True, slots=True)
class MoveLimits:
    """Travel, speed and acceleration of the stage's moves."""

    travel_mm: tuple[float, float]
    speed_max_mm_s: float
    acceleration_mm_s2: float


@dataclass(frozen=True, slots=True)
class ScanSettings:
    """The speed to the start of a scan, and the longest wait for its last events.

    Below ``completeness_min`` a scan fails.
    """

    approach_mm_s: float
    drain_timeout_s: float
    completeness_min: float = 0.9


@dataclass(slots=True)
class ScanSummary:
    """The contents and losses of an assembled scan."""

    profiles: int = 0
    points: int = 0
    events: int = 0
    packets_lost: int = 0
    events_dropped: int = 0
    sigma_median_m: float = math.nan
    message: str = ""
    completeness: float = 0.0
    recording: str = ""

    @property
    def verdict(self) -> str:
        """Return ``complete``, ``partial`` or ``failed``: without any point."""
        if not self.points:
            return "failed"
        lossless = self.completeness >= COMPLETE and not self.packets_lost
        return "complete" if lossless else "partial"

    @property
    def line(self) -> str:
        """Return the verdict, with share and reason unless it is ``complete``."""
        if self.verdict == "complete":
            return self.verdict
        share = f", {self.completeness:.1%}" if self.verdict == "partial" else ""
        return f"{self.verdict}{share}: {self.message or 'look at the log'}"


@dataclass(slots=True)
class Outcome:
    """End of a sequence, with the reason when it did not succeed."""

    end: End = End.ABORTED
    message: str = ""

    @contextmanager
    def steps(self) -> Iterator[None]:
        """Do the steps of a sequence; it ends as they do."""
        try:
            yield
            self.end = End.SUCCEEDED
        except ScanCanceled:
            self.end, self.message = End.CANCELED, "canceled"
        except EschortyError as error:
            self.message = str(error)

    def attempt(self, step: Callable[[], None]) -> None:
        """Run a step of the way out; the sequence fails with it, for the first reason that came."""
        try:
            step()
        except EschortyError as error:
            if self.end is not End.ABORTED:
                self.end, self.message = End.ABORTED, str(error)


@dataclass(slots=True)
class ScanOutcome(Outcome):
    """Outcome of a scan, with the summary of the assembled points."""

    summary: ScanSummary = field(default_factory=ScanSummary)


class Instrument(Protocol):
    """Laser, stage and reconstruction as a sequence uses them.

    Every method that waits does so in ticks (see ``PacedWaiting``).
    """

    def check_nodes(self) -> None:
        """Raise ``ScanFailure`` that names the component that does not answer."""

    def stage_limits(self) -> MoveLimits:
        """Return the limits that the stage publishes; raise ``ScanFailure`` without any."""

    def configure_laser(self, frequency_hz: float, duty: float) -> None:
        """Set the values that are not 0; raise ``ScanFailure`` with the laser's reason."""

    def move(self, position_mm: float, speed_mm_s: float) -> None:
        """Move and wait for the end of the motion."""

    def stop_stage(self) -> None:
        """End a move under way and wait until the stage rests."""

    def laser_on(self) -> None:
        """Start the heartbeat, arm, enable; return when the output reads back on, as it was set."""

    def laser_off(self) -> None:
        """Disable; return when the output reads back off. The heartbeat ends in any case."""

    def watch(self, enabled: bool) -> None:
        """Switch the check of light and events, which raises ``ScanFailure`` at a tick."""

    def shield(self) -> None:
        """Raise no ``ScanCanceled`` from here on."""

    def drain(self, no_progress_s: float, within_s: float) -> None:
        """Wait until the reconstruction has passed the present time.

        The scan fails when it makes no progress for ``no_progress_s``, or when the rest would take
        longer than ``within_s`` at its pace.
        """

    def report(self, phase: str) -> None:
        """Name the phase in the feedback."""


class ScanInstrument(Instrument, Protocol):
    """Instrument for a scan, whose points the reconstruction collects."""

    def begin_scan(self, request: ScanRequest) -> str:
        """Start to collect points; return the recording's folder, ``""`` without one."""

    def end_scan(self, scan_id: str, reason: str) -> ScanSummary:
        """Publish the points collected; ``reason`` is why the scan ends early, ``""`` otherwise."""


def check_request(request: ScanRequest, limits: MoveLimits, unit: str = "m") -> None:
    """Raise ``ArgumentError`` with name, value and remedy unless the scan can be done.

    Lengths in messages are in ``unit``, ``m`` or ``mm``.
    """
    check_sweep(request.start_mm, request.stop_mm, request.speed_mm_s, limits, unit)
    if not 1 <= request.passes <= PASSES_MAX:
        raise ArgumentError(f"passes is {request.passes}; choose 1 to {PASSES_MAX}")
    check_laser(request.frequency_hz, request.duty)
    length_mm = abs(request.stop_mm - request.start_mm)
    scale = 1.0 if unit == "mm" else 1e-3
    if request.frequency_hz and length_mm < request.speed_mm_s / request.frequency_hz:
        raise ArgumentError(
            f"start to stop is {length_mm * scale:.4g} {unit}, less than the travel of one period, "
            f"{request.speed_mm_s / request.frequency_hz * scale:.4g} {unit} at "
            f"{request.speed_mm_s * scale:g} {unit}/s and {request.frequency_hz:g} Hz; choose a "
            "longer sweep or a lower speed"
        )


def check_sweep(
    start_mm: float,
    stop_mm: float,
    speed_mm_s: float,
    limits: MoveLimits,
    unit: str = "m",
    prefix: str = "",
) -> None:
    """Raise ``ArgumentError`` unless the stage can do the sweep; ``prefix`` begins its names."""
    scale = 1.0 if unit == "mm" else 1e-3
    low, high = (f"{end * scale:g}" for end in limits.travel_mm)
    for name, value in (("start", start_mm), ("stop", stop_mm)):
        if not limits.travel_mm[0] <= value <= limits.travel_mm[1]:
            raise ArgumentError(
                f"{prefix}{name} is {value * scale:g} {unit}; choose {low} to {high} {unit}, "
                "the stage's travel"
            )
    if start_mm == stop_mm:
        raise ArgumentError(
            f"{prefix}start and {prefix}stop are both {start_mm * scale:g} {unit}; choose "
            "different ones"
        )
    if not SPEED_MIN_MM_S <= speed_mm_s <= limits.speed_max_mm_s:
        raise ArgumentError(
            f"{prefix}speed is {speed_mm_s * scale:g} {unit}/s; choose "
            f"{SPEED_MIN_MM_S * scale:g} to {limits.speed_max_mm_s * scale:g} {unit}/s"
        )


def check_laser(frequency_hz: float, duty: float) -> None:
    """Raise ``ArgumentError`` unless frequency and duty are 0 or in range; 0 keeps the setting."""
    if frequency_hz != 0.0 and not FREQUENCY_MIN_HZ <= frequency_hz <= FREQUENCY_MAX_HZ:
        raise ArgumentError(
            f"frequency is {frequency_hz:g} Hz; choose {FREQUENCY_MIN_HZ:g} to "
            f"{FREQUENCY_MAX_HZ:g} Hz, or 0 to keep the laser's"
        )
    if not 0.0 <= duty < 1.0:
        raise ArgumentError(
            f"duty is {duty:g}; choose a value between 0 and 1, or 0 to keep the laser's"
        )


def sweep_ends_mm(request: ScanRequest, limits: MoveLimits) -> tuple[float, float]:
    """Return start and end of the sweep, within the travel.

    Speed is constant from start to stop if the travel leaves room for the run-up.
    """
    run_up = 1.1 * request.speed_mm_s**2 / (2.0 * limits.acceleration_mm_s2) + 0.2
    run_up = math.copysign(run_up, request.stop_mm - request.start_mm)
    low, high = limits.travel_mm
    return (
        min(max(request.start_mm - run_up, low), high),
        min(max(request.stop_mm + run_up, low), high),
    )


def crossing_ns(samples: Sequence[tuple[int, float]], level_mm: float) -> int | None:
    """Return the time of the first crossing of ``level_mm``, linear between samples (ns, mm).

    ``None`` when the samples do not cross it.
    """
    for (t0_ns, p0_mm), (t1_ns, p1_mm) in pairwise(samples):
        if p0_mm != p1_mm and min(p0_mm, p1_mm) <= level_mm <= max(p0_mm, p1_mm):
            return t0_ns + round((t1_ns - t0_ns) * (level_mm - p0_mm) / (p1_mm - p0_mm))
    return None


class SweepProgress:
    """The share of a scan's travel between start and stop, of all passes, that is reconstructed."""

    def __init__(self, request: ScanRequest) -> None:
        self._ends_mm = sorted((request.start_mm, request.stop_mm))
        self._travel_mm = request.passes * (self._ends_mm[1] - self._ends_mm[0])
        self._gone_mm = 0.0
        self._last_mm: float | None = None
        self._totals: tuple[float, int, int] | None = None
        self._points = self._profiles = 0.0

    def counts(self, position_mm: float, points: int, profiles: int) -> tuple[int, int]:
        """Return the points and profiles between start and stop so far.

        ``points`` and ``profiles`` are the reconstruction's totals when its newest point is of a
        stage position; a reconstruction that starts again counts on.
        """
        before = self._totals
        if math.isnan(position_mm):
            before = None
        else:
            self._totals = position_mm, points, profiles
        if before is not None and position_mm != before[0]:
            inside_mm = abs(self._limited(position_mm) - self._limited(before[0]))
            share = inside_mm / abs(position_mm - before[0])
            self._points += max(points - before[1], 0) * share
            self._profiles += max(profiles - before[2], 0) * share
        return round(self._points), round(self._profiles)

    def _limited(self, position_mm: float) -> float:
        return min(max(position_mm, self._ends_mm[0]), self._ends_mm[1])

    def share(self, phase: str, position_mm: float) -> float:
        """Return the share, 0 to 1, when the newest point is of a stage position in ``phase``."""
        if phase not in ("sweeping", "finishing") or math.isnan(position_mm):
            return 0.0
        position_mm = self._limited(position_mm)
        if self._last_mm is not None:
            self._gone_mm += abs(position_mm - self._last_mm)
        self._last_mm = position_mm
        return min(self._gone_mm / self._travel_mm, 1.0)


def end_light(instrument: Instrument, outcome: Outcome) -> None:
    """Switch the laser off; unless the sequence has succeeded, stop the stage."""
    instrument.shield()
    instrument.watch(False)
    try:
        outcome.attempt(instrument.laser_off)
    finally:
        if outcome.end is not End.SUCCEEDED:
            outcome.attempt(instrument.stop_stage)


def run_scan(
    instrument: ScanInstrument, request: ScanRequest, settings: ScanSettings
) -> ScanOutcome:
    """Do one scan; raise no ``EschortyError``, leave the laser off and the stage at rest."""
    outcome = ScanOutcome()
    collecting = False
    try:
        with outcome.steps():
            instrument.report("preparing")
            instrument.check_nodes()
            limits = instrument.stage_limits()
            check_request(request, limits)
            begin_mm, end_mm = sweep_ends_mm(request, limits)
            instrument.configure_laser(request.frequency_hz, request.duty)
            instrument.report("to_start")
            instrument.move(begin_mm, min(settings.approach_mm_s, limits.speed_max_mm_s))
            outcome.summary.recording = instrument.begin_scan(request)
            collecting = True
            instrument.laser_on()
            instrument.watch(True)
            instrument.report("sweeping")
            for number in range(request.passes):
                instrument.move(begin_mm if number % 2 else end_mm, request.speed_mm_s)
    finally:
        _finish(instrument, request, settings, outcome, collecting)
    return outcome


def _finish(
    instrument: ScanInstrument,
    request: ScanRequest,
    settings: ScanSettings,
    outcome: ScanOutcome,
    collecting: bool,
) -> None:
    """Run the way out of every scan: laser off first."""
    end_light(instrument, outcome)
    if not collecting:
        return
    instrument.report("finishing")
    # After a failure the last events are kept, without a long wait for a camera that may be lost.
    failed = outcome.end is End.ABORTED
    timeout_s = 1.0 if failed else settings.drain_timeout_s
    within_s = _FAILED_DRAIN_S if failed else _DRAIN_S
    outcome.attempt(lambda: instrument.drain(timeout_s, within_s))

    begun = outcome.summary

    def end_scan() -> None:
        outcome.summary = instrument.end_scan(request.scan_id, outcome.message)

    outcome.attempt(end_scan)
    summary = outcome.summary
    if summary is begun and begun.recording:
        outcome.message += f"; {_use_of(Path(begun.recording))}"
    if outcome.end is End.SUCCEEDED and not (
        summary.points and summary.completeness >= settings.completeness_min
    ):
        outcome.end = End.ABORTED


def _use_of(recording: Path) -> str:
    """Return what can be done with the recording of a reconstruction that has ended."""
    # One of another host cannot be seen here.
    if recording.is_dir() and not (recording / EVENTS_FILE).is_file():
        return "no packet had come, so there is nothing to reconstruct"
    return (
        f"`eschorty reconstruct {shlex.quote(str(recording))}` makes points of what was recorded "
        "until then"
    )
