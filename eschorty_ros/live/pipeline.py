"""Packets and stage samples in, live profiles, points and scans out."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from operator import sub
from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.numbers import number
from eschorty_ros.core.clocks import NS_PER_US
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction import (
    PassLag,
    Settings,
    add_stage,
    pass_lag,
    place,
    take_off_lag,
)
from eschorty_ros.core.storage import Points
from eschorty_ros.live.calibration_capture import Capture
from eschorty_ros.live.packet_stream import PacketStream
from eschorty_ros.live.packet_times import Packet, check_span
from eschorty_ros.live.scan_buffer import AssembledScan, PlacedPoints, ScanBuffer
from eschorty_ros.live.scan_recorder import ScanRecorder
from eschorty_ros.live.sensor_epoch import TimedProfiles
from eschorty_ros.live.stage_placement import StagePlacer
from eschorty_ros.live.sweep_coverage import COMPLETE, SweepCoverage

# Packets wait for the camera's clock and for the worker; a recording begins with one of these.
_STAGE_BEFORE_US = 10_000_000
# Profiles over those that there can be, as a factor and a number, that the ends explain.
_SURPLUS, _ENDS = 1.05, 3


@dataclass(frozen=True, slots=True)
class ScanReport:
    """An assembled scan, the losses while it was collected, and the stream's ``warnings``.

    ``refusal`` is the reason why the last of ``packets_refused`` was refused. ``profiles_max`` is
    the number that the stage's time between start and stop allows, with rests; ``clock_step_ns``
    is how far the computer's clock was set meanwhile. ``cause_of_no_points`` is named where there
    are no warnings.
    """

    scan: AssembledScan
    events: int
    packets: int
    packets_lost: int
    events_dropped: int
    points_without_stage: int
    points_outside: int
    points_over_limit: int
    profiles_expected: int
    cause_of_no_points: str
    warnings: tuple[str, ...] = ()
    pass_lag: PassLag | None = None
    packets_refused: int = 0
    refusal: str = ""
    profiles_max: int = 0
    clock_step_ns: int = 0
    periods_empty: int = 0

    @property
    def completeness(self) -> float:
        """Return the least share of what there should be: of profiles, packets and points.

        It is 0 without points, and where the clock was set, which shifts them. Of too many profiles
        the share is that of those that can be.
        """
        points = len(self.scan.points)
        if not points or self.clock_step_ns:
            return 0.0
        lost = self.points_without_stage + self.points_over_limit
        if self._surplus:
            return self._profiles_possible / self.scan.profiles
        return min(
            _share(self.scan.profiles, self.profiles_expected),
            _share(self.packets, self.packets + self.packets_lost),
            _share(points, points + lost),
        )

    @property
    def message(self) -> str:
        """Return the losses and warnings, or the cause of an empty scan; else ``""``."""
        notes = []
        if self.clock_step_ns:
            notes.append(
                f"the computer's clock was set by {self.clock_step_ns * 1e-9:+.3f} s, which shifts "
                "points along the sweep; scan again"
            )
        if self.points_without_stage:
            notes.append(
                f"{self.points_without_stage} points had no stage position; check that stage/odom "
                "goes on, with stamps of the camera's clock"
            )
        if self.points_over_limit:
            notes.append(f"{self.points_over_limit} points were over the scan's limit")
        refused = self.packets_refused and not self.events
        if not notes and not len(self.scan.points) and not refused:
            notes.append(self._cause_of_empty())
        if self.packets_refused:
            notes.append(f"{self.packets_refused} packets were refused, the last: {self.refusal}")
        if self.packets_lost:
            notes.append(
                f"{self.packets_lost} packets were lost; look at the computer's load and at the "
                "buffers of camera/events"
            )
        if 0 < self.scan.profiles < COMPLETE * self.profiles_expected:
            notes.append(
                f"{self.scan.profiles} profiles of {self.profiles_expected} between start and "
                f"stop; {self.points_outside} points are outside"
            )
            notes += self._causes_of_few()
        if self._surplus:
            notes.append(
                f"{self.scan.profiles} profiles of {self._profiles_possible} between start and "
                "stop, more than there can be; check the stamps of camera/events and stage/odom"
            )
        if len(self.scan.points):
            notes += self.warnings
        return "; ".join(notes)

    @property
    def _profiles_possible(self) -> int:
        return max(self.profiles_expected, self.profiles_max)

    @property
    def _surplus(self) -> bool:
        most = _SURPLUS * self._profiles_possible + _ENDS
        return self.profiles_expected > 0 and self.scan.profiles > most

    def _causes_of_few(self) -> list[str]:
        """Return what the counts of a scan with few profiles show."""
        missing = self.profiles_expected - self.scan.profiles
        found = []
        if 0 < self.profiles_max < COMPLETE * self.profiles_expected:
            found.append(f"the stage was there only for as long as {self.profiles_max} take")
        if 2 * self.periods_empty > missing:
            found.append(
                f"{self.periods_empty} periods had no events; check that light falls on the target"
            )
        if self.events_dropped:
            found.append(f"{self.events_dropped} events were dropped; lower the events' rate")
        return found

    def _cause_of_empty(self) -> str:
        if not (self.events and self.points_outside):
            return f"no points: {'; '.join(self.warnings) or self.cause_of_no_points}"
        if not self.profiles_expected:
            return "no points: the stage has not moved by a profile between start and stop"
        return (
            f"no points: all {self.points_outside} are outside start to stop; check that the "
            "stamps of camera and stage are of the same clock"
        )


def _share(part: int, whole: int) -> float:
    """Return part over whole, at most 1; 1 where the whole is 0."""
    return min(part / whole, 1.0) if whole > 0 else 1.0


class _Counts(NamedTuple):
    """Counts of which a scan reports the difference between its begin and its end."""

    events: int
    packets: int
    packets_lost: int
    events_dropped: int
    packets_refused: int
    periods_empty: int


class Pipeline:
    """Runs packet stream, stage placement and scan buffer; used by one thread.

    - ``clock_timeout_s``, ``stage_gap_s``, ``stage_timeout_s``, ``packet_period_s``: See
      ``PacketStream`` and ``StagePlacer``.

    Public attributes:
    - ``calibration``: That of packets processed from now on.
    - ``stream``, ``placer``: The packet stream and the stage placement.
    - ``packets_refused``: Packets that were refused as a whole.
    - ``profiles``, ``points``: Numbers of profiles completed and of points placed.
    - ``capture``: Receives a calibration's events and placed profiles while it is set.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: Settings,
        clock_timeout_s: float,
        stage_gap_s: float,
        stage_timeout_s: float,
        packet_period_s: float = 0.0,
    ) -> None:
        self.calibration = calibration
        self.stream = PacketStream(calibration, settings, clock_timeout_s, packet_period_s)
        self.placer = StagePlacer(stage_gap_s, stage_timeout_s)
        self.packets_refused = 0
        self._refusal = ""
        self.profiles = 0
        self.points = 0
        self.capture: Capture | None = None
        self._fresh: list[TimedProfiles] = []
        self._buffer: ScanBuffer | None = None
        self._recorder: ScanRecorder | None = None
        self._closed_s = math.inf
        self._clock_step_ns = 0
        self._coverage = SweepCoverage(0.0, 0.0)
        self._counts_at_begin = _Counts(0, 0, 0, 0, 0, 0)
        self._counters_at_begin: Counter[str] = Counter()

    @property
    def scan_id(self) -> str:
        """Return the identifier of the scan being collected, ``""`` without one."""
        return self._buffer.scan_id if self._buffer is not None else ""

    def add_packet(self, packet: Packet, now_s: float) -> None:
        """Queue a packet for the next :meth:`process`.

        Raises ``FormatError`` for a packet without the time of a camera.
        """
        try:
            check_span(packet.data)
        except FormatError as error:
            self.note_refused(str(error))
            raise
        self.stream.add(packet, now_s)
        if self.capture is not None:
            self.capture.packet(packet)

    def note_refused(self, reason: str) -> None:
        """Count a packet that was refused, for the report of the scan."""
        self.packets_refused += 1
        self._refusal = reason

    def process(self, now_s: float) -> None:
        """Reconstruct the packets that need not wait."""
        self._receive(self.stream.process(now_s), now_s)

    def add_stage(self, t_ns: int, position_mm: float) -> None:
        """Add one stage sample at ROS time ``t_ns``."""
        self.placer.add_stage(t_ns, position_mm)
        if self._buffer is not None:
            self._coverage.add(t_ns, position_mm)
        if self._recorder is not None:
            self._recorder.stage(t_ns, position_mm)

    def follow_clock(self, step_ns: int) -> bool:
        """Return whether the camera's clock starts again as the computer's was set by this much."""
        restarted = self.stream.restart_clock()
        if restarted:
            self._clock_step_ns = step_ns
        return restarted

    def complete(self, now_s: float) -> list[TimedProfiles]:
        """Return the profiles completed since the last call."""
        self.process(now_s)
        fresh, self._fresh = self._fresh, []
        return fresh

    def place(self, now_s: float) -> list[PlacedPoints]:
        """Return the points whose stage position has become known."""
        self.stream.fit_edges(self.placer.track)
        ready = self.placer.ready(now_s)
        if self.capture is not None:
            for timed, stage_mm in ready:
                self.capture.profiles(timed, stage_mm)
        placed = [self._placed(timed, mm) for timed, mm in ready]
        for part in placed:
            self.points += len(part)
            if self._buffer is not None:
                self._buffer.add(part)
        return placed

    def set_calibration(self, calibration: Calibration) -> None:
        """Use ``calibration`` for packets processed later.

        Raises ``ArgumentError`` while a scan is being collected: one scan has one calibration.
        """
        if self._buffer is not None:
            raise ArgumentError(
                f"scan {self._buffer.scan_id!r} is being collected; end it before changing the "
                "calibration"
            )
        self.stream.set_calibration(calibration)
        self.calibration = calibration

    def begin_scan(
        self,
        scan_id: str,
        start_mm: float,
        stop_mm: float,
        recorder: ScanRecorder | None = None,
        passes: int = 1,
        speed_mm_s: float = 0.0,
    ) -> None:
        """Start collecting, and recording; a repeated request, after a lost answer, does nothing.

        A ``speed_mm_s`` of 0 leaves that of the settings.

        Raises ``ArgumentError`` when another scan is being collected already, or for bad limits.
        """
        if self._buffer is not None:
            if self._buffer.scan_id == scan_id:
                return
            raise ArgumentError(
                f"scan {self._buffer.scan_id!r} is being collected; end it before beginning "
                f"{scan_id!r}"
            )
        if self.capture is not None:
            raise ArgumentError("a calibration is running; wait for its end or cancel it")
        if number("speed_mm_s", speed_mm_s, 0.0):
            self.stream.set_stage_speed(math.copysign(speed_mm_s, stop_mm - start_mm))
        # What still waits for a stage position is of before the scan.
        since_ns = self.stream.processed_until_ns
        self._buffer = ScanBuffer(scan_id, start_mm, stop_mm, since_ns)
        self.placer.begin_scan(since_ns)
        self._closed_s = math.inf
        self._clock_step_ns = 0
        self._coverage = SweepCoverage(start_mm, stop_mm, passes)
        self._recorder = recorder
        if recorder is not None and self.placer.track.last_us is not None:
            since_us = self.placer.track.last_us - _STAGE_BEFORE_US
            for t_us, position_mm in zip(*self.placer.track.samples_from(since_us), strict=True):
                recorder.stage(int(t_us) * NS_PER_US, float(position_mm))
        self.stream.begin_scan(recorder)
        self._counts_at_begin = self._counts()
        self._counters_at_begin = self.stream.counters

    def set_capture(self, capture: Capture | None) -> None:
        """Start to feed a calibration's capture, or stop with ``None``.

        Raises ``ArgumentError`` while a scan is being collected.
        """
        if capture is not None and self._buffer is not None:
            raise ArgumentError(
                f"scan {self._buffer.scan_id!r} is being collected; calibrate after its end"
            )
        self.capture = capture

    def close_period(self, scan_id: str, now_s: float) -> None:
        """Begin the end of a scan: complete the open period, since the laser is off.

        Raises ``ArgumentError`` when ``scan_id`` is not the scan being collected.
        """
        if self._buffer is None or self._buffer.scan_id != scan_id:
            raise ArgumentError(
                f"scan {scan_id!r} is not being collected; "
                + (f"end {self.scan_id!r} or " if self.scan_id else "")
                + "begin it first"
            )
        self._receive(self.stream.flush(), now_s)
        self._closed_s = now_s
        self.stream.end_recording()

    def end_scan(self, reason: str = "") -> ScanReport:
        """Return the scan that was collected; what still waits for the stage is lost.

        ``reason`` is why the recording is not that of the entire scan, ``""`` where it is.
        Points are placed again, by the clock as fitted to the entire sweep, and less the lag that
        passes back and forth show.
        """
        assert self._buffer is not None
        buffer, self._buffer = self._buffer, None
        self.placer.discard(self._closed_s)
        self.stream.fit_edges(self.placer.track, now=True)
        scan = buffer.assemble(self._placed_again)
        where = scan.points, scan.stamp_ns // NS_PER_US, self.placer.track
        direction = self.calibration.stage_direction
        lag = pass_lag(*where, direction)
        if lag is not None:
            take_off_lag(*where, direction, lag.lag_us)
        self.end_recording(scan.points, reason)
        counts = _Counts(*map(sub, self._counts(), self._counts_at_begin))
        return ScanReport(
            scan,
            **counts._asdict(),
            points_without_stage=self.placer.points_without_stage_of_scan,
            points_outside=buffer.points_outside,
            points_over_limit=buffer.points_over_limit,
            profiles_expected=self._coverage.profiles(self.stream.profile_rate_hz),
            cause_of_no_points=self.stream.cause_of_no_points(self._counters_at_begin),
            warnings=tuple(self.stream.warnings),
            pass_lag=lag,
            refusal=self._refusal,
            profiles_max=self._coverage.profiles_max(self.stream.profile_rate_hz),
            clock_step_ns=self._clock_step_ns,
        )

    def end_recording(self, points: Points | None, reason: str = "") -> None:
        """Let the recorder of the scan write its last files; ``reason`` see ``ScanRecorder``."""
        recorder, self._recorder = self._recorder, None
        self.stream.end_recording()
        if recorder is not None:
            recorder.end(points, reason)

    def _receive(self, timed: list[TimedProfiles], now_s: float) -> None:
        for part in timed:
            self.profiles += part.profiles.profile_count
            self._fresh.append(part)
            self.placer.add_profiles(part, now_s)

    def _placed(self, timed: TimedProfiles, stage_mm: np.ndarray) -> PlacedPoints:
        points = place(timed.profiles, timed.model, stage_mm, timed.stage_direction)
        return PlacedPoints(points, timed.t_ns, timed.edge_ns, stage_mm, timed.sensor)

    def _placed_again(self, part: PlacedPoints) -> PlacedPoints:
        if part.sensor is None:
            return part
        t_ns, edge_ns = part.sensor.to_ns()
        stage_mm = self.placer.track.position_mm(t_ns // NS_PER_US)
        # The odometry is bounded: points before its first sample keep their position.
        known = np.isfinite(stage_mm)
        stage_mm = np.where(known, stage_mm, part.stage_mm)
        points = part.points.copy()
        add_stage(points, stage_mm - part.stage_mm, self.calibration.stage_direction)
        return PlacedPoints(
            points,
            np.where(known, t_ns, part.t_ns),
            np.where(known, edge_ns, part.edge_ns),
            stage_mm,
            part.sensor,
        )

    def _counts(self) -> _Counts:
        counters = self.stream.counters
        return _Counts(
            events=counters["events"],
            packets=self.stream.packets,
            packets_lost=self.stream.packets_lost,
            events_dropped=counters["events_over_column_limit"],
            packets_refused=self.packets_refused,
            periods_empty=counters["periods_empty"],
        )
