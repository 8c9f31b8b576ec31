"""The events and profiles of a calibration, and the targets found in them so far."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import EschortyError, FitError
from eschorty_ros.core.calibration import (
    AggregateFrame,
    KnownTarget,
    Targets,
    find_posts,
    fit,
    match_posts,
    moving_target,
)
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction import Profiles
from eschorty_ros.live.packet_times import Packet
from eschorty_ros.live.sensor_epoch import TimedProfiles

_TARGETS_LEAST = 3
_REASONS_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Sweep:
    """A move of the one target by the stage, from ``start_mm`` to ``stop_mm`` and back.

    Its range changes by ``range_per_stage`` times the stage's move.
    """

    start_mm: float
    stop_mm: float
    speed_mm_s: float
    range_per_stage: float


@dataclass(frozen=True, slots=True)
class CaptureRequest:
    """A capture's parameters; ``frequency_hz`` or ``duty`` 0 keeps the laser's setting."""

    targets: tuple[KnownTarget, ...]
    method: str = "joint"
    capture_s: float = 1.0
    frequency_hz: float = 0.0
    duty: float = 0.0
    sweep: Sweep | None = None


@dataclass(frozen=True, slots=True)
class Findings:
    """The targets found in a capture."""

    targets: Targets | None = None
    """Known targets that were found."""
    posts: int = 0
    """Posts found, known or not."""
    rejected: tuple[str, ...] = ()
    """Posts and targets without a match, with the reason."""
    residual_px: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    """Residuals of the targets in a fit of k' and b'; empty below two targets."""


class Capture(ABC):
    """Events and profiles of a calibration; one thread fills it, others search copies.

    Its decoder may start anywhere in the stream.

    Public attributes:
    - ``frame``: The sum of all events.
    - ``packets_lost``: Packets missing by their ``seq``.
    """

    def __init__(self, nominal: Calibration) -> None:
        self._nominal = nominal
        self._decoder = Decoder(nominal.columns, nominal.rows)
        self._next_seq: int | None = None
        self.frame = AggregateFrame(nominal.columns, nominal.rows)
        self.packets_lost = 0

    def packet(self, packet: Packet) -> None:
        """Add the events of a packet to the frame."""
        missing = 0 if self._next_seq is None else packet.seq - self._next_seq
        if missing:
            self.packets_lost += max(missing, 0)
            self._decoder.note_gap()
        self._next_seq = packet.seq + 1
        self.frame.add(self._decoder.decode(packet.data))

    @abstractmethod
    def profiles(self, timed: TimedProfiles, stage_mm: NDArray[np.float64]) -> None:
        """Add profiles whose stage positions are known."""

    @abstractmethod
    def find(self, frame: AggregateFrame) -> Findings:
        """Search the targets in a copy of the frame."""


class PostsCapture(Capture):
    """A capture of targets at rest, side by side.

    - ``nominal``: The build as designed.
    """

    def __init__(self, request: CaptureRequest, nominal: Calibration, line_width_px: float) -> None:
        super().__init__(nominal)
        self._known = request.targets
        self._line_width_px = line_width_px

    def profiles(self, timed: TimedProfiles, stage_mm: NDArray[np.float64]) -> None:
        """Add nothing: the frame is enough for posts at rest."""

    def find(self, frame: AggregateFrame) -> Findings:
        """Find posts in the frame and match them with the known targets."""
        posts = find_posts(frame, self._line_width_px)
        match = match_posts(posts, self._known, self._nominal.model())
        return Findings(
            match.targets, len(posts), match.rejected, _residuals(match.targets, self._nominal)
        )


class SweepCapture(Capture):
    """A capture of one target that the stage moves along the range.

    - ``request``: With a sweep.
    """

    def __init__(self, request: CaptureRequest, nominal: Calibration) -> None:
        super().__init__(nominal)
        assert request.sweep is not None
        self._target = request.targets[0]
        self._sweep: Sweep = request.sweep
        self._parts: list[tuple[Profiles, NDArray[np.float64]]] = []

    def profiles(self, timed: TimedProfiles, stage_mm: NDArray[np.float64]) -> None:
        """Keep profiles and their stage positions."""
        self._parts.append((timed.profiles, stage_mm))

    def find(self, frame: AggregateFrame) -> Findings:
        """Measure the target in the profiles."""
        parts = list(self._parts)
        if not parts:
            return Findings(rejected=(f"target {self._target.label}: no profile shows it",))
        profiles = Profiles.concatenate([part for part, _ in parts])
        targets = moving_target(
            profiles,
            np.concatenate([stage_mm for _, stage_mm in parts]),
            self._target.range_mm,
            range_per_stage=self._sweep.range_per_stage,
            sigma_at_zero_mm=self._target.sigma_range_mm,
        )
        lost = profiles.profile_count - len(targets)
        rejected = (f"{lost} profiles show no whole target, or one off the others",) * (lost > 0)
        return Findings(targets, 1, rejected, _residuals(targets, self._nominal))


def enough_targets(findings: Findings, expected: int) -> Targets:
    """Return the targets found.

    Raises ``FitError`` for less than three, or than ``expected`` if that is less; gives the first
    reasons.
    """
    targets = findings.targets
    found = len(targets) if targets is not None else 0
    if targets is not None and found >= min(_TARGETS_LEAST, expected):
        return targets
    reasons = list(findings.rejected[:_REASONS_SHOWN])
    if len(findings.rejected) > _REASONS_SHOWN:
        reasons.append(f"and {len(findings.rejected) - _REASONS_SHOWN} more")
    raise FitError(
        f"{found} of {expected} targets found among {findings.posts} posts; " + "; ".join(reasons)
    )


def make_capture(request: CaptureRequest, nominal: Calibration, line_width_px: float) -> Capture:
    """Make the capture of a request."""
    if request.sweep is not None:
        return SweepCapture(request, nominal)
    return PostsCapture(request, nominal, line_width_px)


def _residuals(targets: Targets | None, nominal: Calibration) -> NDArray[np.float64]:
    if targets is None or len(targets) < 2:
        return np.empty(0)
    try:
        rows = Targets(targets.row, targets.range_mm, targets.sigma_row_px)
        return fit(rows, nominal.model()).residual_px
    except EschortyError:
        return np.empty(0)
