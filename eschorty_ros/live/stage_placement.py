"""Placement of profiles by the stage's position at their time, which may arrive later."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.clocks import NS_PER_US, StageTrack
from eschorty_ros.live.sensor_epoch import TimedProfiles

_HISTORY_US = 600_000_000
# Odometry comes in order: a stamp further back than this comes from a clock that was set.
_CLOCK_BACK_US = 100_000
# A stage at rest gives no pulses, and a wire may be off: longest wait for an edge.
_EDGE_WAIT_S = 0.3
# DDS repeats what got lost within 3 s.
_STAGE_ENDED_S = 3.5


class StagePlacer:
    """Joins profiles and stage positions by time; interpolates, never extrapolates.

    A profile's ROS times are computed when its position is known, by the clock of that time.
    Where edges of the stage are expected, a profile waits until edges cover its time.

    - ``gap_s``: Longest time between two stage samples that is bridged; 0 bridges any.
    - ``timeout_s``: Longest time (steady clock) a profile waits for a stage position.

    Public attributes:
    - ``points_without_stage``: Points discarded because no position covers their time.
    - ``points_without_stage_of_scan``: Those of periods since :meth:`begin_scan`.
    - ``waiting``: Points that wait for a stage position.
    - ``track_restarts``: Restarts of the odometry because its stamps went back: the clock was set,
      or a recording is played again.
    - ``track``: The odometry over ROS time, us, since the last restart.
    """

    def __init__(self, gap_s: float, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        self.points_without_stage = 0
        self.points_without_stage_of_scan = 0
        self.waiting = 0
        self._since_ns: int | None = None
        self._lost_ns = 0
        self.track_restarts = 0
        self._late_before = 0
        self._sampled: tuple[int, float] | None = None
        self._now_s = 0.0
        self.track = StageTrack(max_gap_us=round(gap_s * 1e6) or None)
        self._waiting: deque[tuple[float, TimedProfiles]] = deque()

    @property
    def late_samples(self) -> int:
        """Return the number of stage samples left out: not later than the one before."""
        return self._late_before + self.track.dropped

    @property
    def newest_sample(self) -> str:
        """Return where the newest stage sample is from the last points that were discarded."""
        if self.track.last_us is None:
            return "nothing has come on stage/odom"
        apart_s = (self.track.last_us * NS_PER_US - self._lost_ns) * 1e-9
        return f"the newest sample of stage/odom is {apart_s:+.3f} s from them"

    def set_gap(self, gap_s: float) -> None:
        """Change the longest time between two samples that is bridged."""
        self.track.max_gap_us = round(gap_s * 1e6) or None

    def add_stage(self, t_ns: int, position_mm: float) -> None:
        """Add one stage sample at ROS time ``t_ns``."""
        t_us = t_ns // NS_PER_US
        if self.track.last_us is not None and t_us < self.track.last_us - _CLOCK_BACK_US:
            self._late_before += self.track.dropped
            self.track = StageTrack(self.track.max_gap_us)
            self.track_restarts += 1
        self.track.append(t_us, position_mm)
        assert self.track.last_us is not None
        self.track.drop_before(self.track.last_us - _HISTORY_US)

    def add_profiles(self, timed: TimedProfiles, now_s: float) -> None:
        """Queue profiles that arrived at ``now_s`` of the steady clock."""
        if len(timed.profiles):
            self._waiting.append((now_s, timed))
            self.waiting += len(timed.profiles)

    def begin_scan(self, since_ns: int | None) -> None:
        """Count the losses of a scan: of periods that begin from this ROS time on, or of all."""
        self.points_without_stage_of_scan, self._since_ns = 0, since_ns

    def holds(self, until_s: float) -> bool:
        """Return whether a profile that arrived by ``until_s`` of the steady clock waits.

        It need not wait for a stage that has sent nothing for 3.5 s.
        """
        ended = self._sampled is not None and self._now_s - self._sampled[1] > _STAGE_ENDED_S
        return not ended and bool(self._waiting) and self._waiting[0][0] <= until_s

    def ready(self, now_s: float) -> list[tuple[TimedProfiles, NDArray[np.float64]]]:
        """Return the profiles whose positions (mm, float64) are known, oldest first."""
        placed = []
        left: deque[tuple[float, TimedProfiles]] = deque()
        last_us = self.track.last_us
        self._now_s = now_s
        if last_us is not None and (self._sampled is None or self._sampled[0] != last_us):
            self._sampled = last_us, now_s
        for arrived_s, waiting in self._waiting:
            waited_s = now_s - arrived_s
            # All of a part together: to copy those that are known costs more than they gain.
            if waited_s <= self.timeout_s and (
                last_us is None
                or waiting.latest_ns() // NS_PER_US > last_us
                or (waited_s <= _EDGE_WAIT_S and not waiting.covered)
            ):
                left.append((arrived_s, waiting))
                continue
            timed = waiting.retimed()
            position_mm = self.track.position_mm(timed.t_ns // NS_PER_US)
            known = ~np.isnan(position_mm)
            self._lose(timed, ~known)
            if known.all():
                placed.append((timed, position_mm))
            elif known.any():
                placed.append((timed.select(known), position_mm[known]))
        self._leave(left)
        return placed

    def discard(self, until_s: float) -> None:
        """Discard and count the profiles that arrived by ``until_s`` and wait."""
        left: deque[tuple[float, TimedProfiles]] = deque()
        for arrived_s, waiting in self._waiting:
            if arrived_s <= until_s:
                self._lose(waiting.retimed(), np.ones(len(waiting.profiles), bool))
            else:
                left.append((arrived_s, waiting))
        self._leave(left)

    def _lose(self, timed: TimedProfiles, lost: NDArray[np.bool_]) -> None:
        if lost.any():
            self._lost_ns = int(timed.t_ns[lost].max())
        self.points_without_stage += int(np.count_nonzero(lost))
        of_scan = lost if self._since_ns is None else lost & (timed.edge_ns >= self._since_ns)
        self.points_without_stage_of_scan += int(np.count_nonzero(of_scan))

    def _leave(self, left: deque[tuple[float, TimedProfiles]]) -> None:
        self._waiting = left
        self.waiting = sum(len(timed.profiles) for _, timed in left)
