"""The sensor's time from one start of the camera to the next, and what carries it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.clock import SensorClock, StageTrack
from eschorty_ros.core.edge_clock import EdgeClock
from eschorty_ros.core.profiles import Profiles
from eschorty_ros.core.pulses import PulseTrain

_UNSEEN_US = -(1 << 62)
_PULSES_MISSING = 30


class SensorEpoch:
    """Clock of one stretch of sensor time that never goes back.

    Parameters
    ----------
    clock : SensorClock
    pulses : PulseTrain or None
        Where the stage gives pulses to the camera's trigger input, if it is wired to the stage.

    Attributes
    ----------
    clock : SensorClock
    edges : EdgeClock
    edges_missing : bool
        Whether the stage has passed many pulses since the last edge that fits.
    """

    def __init__(self, clock: SensorClock, pulses: PulseTrain | None = None) -> None:
        self.clock = clock
        self.edges = EdgeClock(pulses)
        self.edges_missing = False
        self._passed_mm = 0.0
        self._position_mm: float | None = None

    @property
    def expects_edges(self) -> bool:
        """Whether edges of the stage are to tell the time."""
        return self.edges.pulses is not None and not self.clock.exact

    def set_pulses(self, pulses: PulseTrain | None) -> None:
        """Take pulses at other places from now on, or none."""
        if pulses != self.edges.pulses:
            self.edges = EdgeClock(pulses)
            self.clock.adopt(None)

    def follow(self, track: StageTrack, *, now: bool = False) -> None:
        """Let the clock follow edges that have come in, and with ``now`` the very newest, too."""
        arrivals = self.clock.arrival_line
        if arrivals is None or not self.expects_edges:
            return
        if self.edges.update(track, arrivals, now=now):
            assert self.edges.fit is not None
            self.clock.adopt(self.edges.fit.line)
            self._passed_mm = 0.0
        self._count_pulses(track)

    def _count_pulses(self, track: StageTrack) -> None:
        assert self.edges.pulses is not None
        if track.last_us is None:
            return
        position_mm = float(track.position_mm(np.array([track.last_us]))[0])
        if self._position_mm is not None:
            self._passed_mm += abs(position_mm - self._position_mm)
        self._position_mm = position_mm
        self.edges_missing = self._passed_mm > _PULSES_MISSING * self.edges.pulses.interval_mm

    def settled(self, t_us: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which sensor times edges cover, if edges are expected."""
        if not self.expects_edges:
            return np.ones(t_us.shape, dtype=bool)
        until_us = self.edges.until_us
        return t_us <= (_UNSEEN_US if until_us is None else until_us)


@dataclass(frozen=True, slots=True)
class SensorTimes:
    """Sensor times of points and of their periods' rising edges, int64 us, within one epoch."""

    epoch: SensorEpoch
    t_us: NDArray[np.int64]
    edge_us: NDArray[np.int64]

    def select(self, mask: NDArray[np.bool_] | NDArray[np.intp]) -> SensorTimes:
        """Points where ``mask`` says."""
        return SensorTimes(self.epoch, self.t_us[mask], self.edge_us[mask])

    def to_ns(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """ROS times as the clock has them now."""
        return self.epoch.clock.to_ns(self.t_us), self.epoch.clock.to_ns(self.edge_us)


@dataclass(frozen=True, slots=True)
class TimedProfiles:
    """Profiles with int64 ROS nanoseconds of each point and of its period's rising edge.

    ``sensor`` holds the sensor times where the clock may still get better.
    """

    profiles: Profiles
    t_ns: NDArray[np.int64]
    edge_ns: NDArray[np.int64]
    sensor: SensorTimes | None = None

    @classmethod
    def within(cls, epoch: SensorEpoch, profiles: Profiles, shift_us: int) -> TimedProfiles:
        """Profiles whose times are ``shift_us`` less than the epoch's."""
        sensor = SensorTimes(epoch, profiles.t_us + shift_us, profiles.edge_us + shift_us)
        return cls(profiles, *sensor.to_ns(), None if epoch.clock.exact else sensor)

    def select(self, mask: NDArray[np.bool_]) -> TimedProfiles:
        """Points where ``mask`` is set."""
        sensor = None if self.sensor is None else self.sensor.select(mask)
        return TimedProfiles(
            self.profiles.select(mask), self.t_ns[mask], self.edge_ns[mask], sensor
        )

    def retimed(self) -> TimedProfiles:
        """Give the same points the ROS times that the clock has for them now."""
        if self.sensor is None:
            return self
        t_ns, edge_ns = self.sensor.to_ns()
        return replace(self, t_ns=t_ns, edge_ns=edge_ns)

    def earliest_ns(self) -> int:
        """ROS time of the first point as the clock has it now."""
        if self.sensor is None:
            return int(self.t_ns.min())
        return self.sensor.epoch.clock.to_ns(int(self.sensor.t_us.min()))

    def settled(self) -> NDArray[np.bool_]:
        """Tell which points' times are as good as they will be while the stage moves."""
        if self.sensor is None:
            return np.ones(len(self.t_ns), dtype=bool)
        return self.sensor.epoch.settled(self.sensor.t_us)
