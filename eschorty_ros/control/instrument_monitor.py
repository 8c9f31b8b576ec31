"""Newest status of laser, stage and reconstruction, with checks of its age."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from eschorty_ros.control.heartbeat import Sender, read_heartbeat
from eschorty_ros.control.scan_sequence import MoveLimits, ScanFailure
from eschorty_ros.control.stamp_ages import StampAges
from eschorty_ros.hardware.base.protocols import LaserOutput

# With Fast DDS's defaults a lost message is repeated after 3 s.
_STALE_S = 3.5
# A laser reports nothing during a command.
_REPORT_TIMEOUT_S = 2.5
_REST_MM_S = 0.1
# A stage ends its move after some more readings at rest, and refuses the next one until then.
_MOVE_ENDS_S = 0.3
# A stage needs some seconds to begin a move, and longer on a busy computer.
_MOTION_S = 15.0
_HEARTBEAT_S = 3.0
_MODULATION_TOLERANCE = 1e-3
_SAMPLES_MAX = 500_000


@dataclass(frozen=True, slots=True)
class LaserReport:
    """The output (a value of ``LaserOutput``) and modulation read back, and the output's reason."""

    output: int
    frequency_hz: float
    duty: float
    reason: str


@dataclass(frozen=True, slots=True)
class ReconstructionStatus:
    """Progress of the reconstruction, ROS time in ns, and its totals since its start.

    ``packet_age_s`` is the least age of the last second's packets on arrival, NaN without any.
    """

    processed_until_ns: int
    events_per_second: float
    profiles: int
    points: int
    scan_id: str
    packet_age_s: float = math.nan


class InstrumentMonitor:
    """Newest status of the other components, aged on the steady clock.

    - ``camera_present``: Returns whether a node publishes events.

    Public attributes:
    - ``limits``: The stage's, ``None`` before they come.
    - ``laser_failed``: Whether the laser's node has failed since the newest status.
    - ``samples``: ROS time (ns) and stage position (mm) since ``restart_samples``; none before.
    """

    def __init__(self, camera_present: Callable[[], bool]) -> None:
        self._camera_present = camera_present
        self.samples: deque[tuple[int, float]] = deque(maxlen=_SAMPLES_MAX)
        self._samples_from_ns = math.inf
        self.limits: MoveLimits | None = None
        self.laser: LaserReport | None = None
        self.laser_failed = False
        self.reconstruction: ReconstructionStatus | None = None
        self.position_mm = math.nan
        self._rests = False
        self._in_motion_s = -math.inf
        self.until_ns = 0
        self._reported_s = dict.fromkeys(("laser", "stage", "reconstruction"), 0.0)
        self._advanced_s = self._moved_s = 0.0
        # Another program's reconstruction may have no heartbeat.
        self._heartbeat_s = math.inf
        self._sender: Sender | None = None
        names = ("reconstruction", "camera", "laser", "stage")
        self._ages = {name: StampAges(name) for name in names}

    def update_laser(self, status: LaserReport, age_s: float) -> None:
        """Store the laser's newest status, which arrived ``age_s`` after its stamp."""
        self.laser, self._reported_s["laser"] = status, time.monotonic()
        # One that was started again may be discovered after it has been configured.
        self.laser_failed = False
        self._ages["laser"].add(age_s)

    def update_reconstruction(self, status: ReconstructionStatus, age_s: float) -> None:
        """Store the reconstruction's newest status, which arrived ``age_s`` after its stamp."""
        now_s = time.monotonic()
        self._ages["reconstruction"].add(age_s)
        if math.isfinite(status.packet_age_s):
            self._ages["camera"].add(status.packet_age_s)
        if status.processed_until_ns != self.until_ns:
            self.until_ns, self._advanced_s = status.processed_until_ns, now_s
        self.reconstruction, self._reported_s["reconstruction"] = status, now_s

    def update_stage(
        self, t_ns: int, position_mm: float, velocity_mm_s: float, age_s: float
    ) -> None:
        """Store a sample of the stage's position, which arrived ``age_s`` after its stamp."""
        now_s = time.monotonic()
        if position_mm != self.position_mm:
            self._moved_s = now_s
        self.position_mm = position_mm
        self._reported_s["stage"] = now_s
        self._ages["stage"].add(age_s)
        self._rests = abs(velocity_mm_s) < _REST_MM_S
        if not self._rests:
            self._in_motion_s = now_s
        # Those of the motion before may still come.
        if t_ns >= self._samples_from_ns:
            self.samples.append((t_ns, position_mm))

    def restart_samples(self, from_ns: float) -> None:
        """Keep the stage's samples from this ROS time on; ``inf`` keeps none."""
        self._samples_from_ns = from_ns
        self.samples.clear()

    def reconstructed_mm(self) -> float:
        """Return where the stage was at the newest event reconstructed, NaN when not known."""
        samples = reversed(list(self.samples))
        return next((mm for t_ns, mm in samples if t_ns <= self.until_ns), math.nan)

    def update_heartbeat(self, text: str) -> None:
        """Store a heartbeat of the reconstruction."""
        self._sender, stopped = read_heartbeat(text)
        self._heartbeat_s = -math.inf if stopped else time.monotonic()

    @property
    def output(self) -> int | None:
        """Return the output that the laser reads back, ``None`` before its first status."""
        return self.laser.output if self.laser is not None else None

    def other_modulation(self, frequency_hz: float, duty: float) -> str:
        """Return how the modulation read back differs, ``""`` if it does not; 0 is any value."""
        if self.laser is None:
            return "laser: no state"
        for name, requested, read, unit in (
            ("frequency", frequency_hz, self.laser.frequency_hz, " Hz"),
            ("duty", duty, self.laser.duty, ""),
        ):
            if requested and not math.isclose(read, requested, rel_tol=_MODULATION_TOLERANCE):
                return f"laser: {name} reads back {read:g}{unit}, requested {requested:g}{unit}"
        return ""

    @property
    def at_rest(self) -> bool:
        """Return whether the stage rests and its move has had time to end."""
        return self._rests and _age_s(self._in_motion_s) > _MOVE_ENDS_S

    @property
    def stage_reports(self) -> bool:
        """Return whether odometry is fresh."""
        return _age_s(self._reported_s["stage"]) < _STALE_S

    @property
    def laser_reports(self) -> bool:
        """Return whether the laser's state is fresh."""
        return self.laser is not None and _age_s(self._reported_s["laser"]) < _STALE_S

    def report_late(self, component: str) -> bool:
        """Return whether ``laser``, ``stage`` or ``reconstruction`` no longer reports."""
        return _age_s(self._reported_s.get(component, math.inf)) > _REPORT_TIMEOUT_S

    def restart_progress(self) -> None:
        """Count the time without progress of the reconstruction from now."""
        self._advanced_s = time.monotonic()

    def check_stage(self) -> None:
        """Raise ``ScanFailure`` when odometry stopped."""
        if not self.stage_reports:
            raise ScanFailure(f"stage: no odometry for {_STALE_S:g} s; check that its node runs")

    def check_motion(self, begun_s: float) -> None:
        """Raise ``ScanFailure`` when a move that began then has ended without a result."""
        if _age_s(max(begun_s, self._moved_s)) > _MOTION_S:
            raise ScanFailure(
                f"stage: it rests at {self.position_mm * 1e-3:g} m, but its move does not end; "
                "look at the log of its node"
            )

    def check_clocks(self) -> None:
        """Raise ``ScanFailure`` when a node's stamps are not of this host's time."""
        for ages in self._ages.values():
            ages.check()

    def check_reconstruction(self) -> None:
        """Raise ``ScanFailure`` when the reconstruction's process or its heartbeat has ended."""
        fault = self._sender.fault() if self._sender is not None else ""
        if not fault and _age_s(self._heartbeat_s) > _HEARTBEAT_S:
            fault = "its heartbeat has stopped"
        if fault:
            raise ScanFailure(f"reconstruction: {fault}; the scan ends")

    def check_progress(self, timeout_s: float) -> None:
        """Raise ``ScanFailure`` when the reconstruction made no progress for ``timeout_s``."""
        if _age_s(self._advanced_s) > timeout_s:
            cause, _, remedy = self.cause_of_no_progress().partition("; ")
            raise ScanFailure(f"{cause} for {timeout_s:g} s; {remedy or 'check that it runs'}")

    def check_laser(self) -> None:
        """Raise ``ScanFailure`` when the laser does not report or is not on."""
        if self.laser is None or not self.laser_reports:
            raise ScanFailure(f"laser: no state for {_STALE_S:g} s; check that its node runs")
        if self.laser.output != LaserOutput.ON:
            raise ScanFailure(f"laser: went off: {self.laser.reason}")

    def check_laser_works(self) -> None:
        """Raise ``ScanFailure`` with the laser's reason when it has failed or may be on or off."""
        unknown = self.laser_reports and self.output == LaserOutput.UNKNOWN
        if self.laser is not None and (self.laser_failed or unknown):
            raise ScanFailure(f"laser: {self.laser.reason.removeprefix('laser ')}")

    def cause_of_no_progress(self) -> str:
        """Return the component without which the reconstruction does not advance."""
        if _age_s(self._reported_s["reconstruction"]) > _STALE_S:
            return "reconstruction: it does not report"
        if not self._camera_present():
            return "camera: no publisher of camera/events; look at the log of its node"
        if self.reconstruction and math.isfinite(self.reconstruction.packet_age_s):
            busy = "reconstruction: packets arrive, but it processes none"
            return f"{busy}; look at the computer's load and at its log"
        return "camera: no events reach the reconstruction; look at the logs of both nodes"


def _age_s(at_s: float) -> float:
    return time.monotonic() - at_s
