"""The clock of the sensor between two starts of the camera, and profiles timed by it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.clocks import EdgeClock, PulseTrain, SensorClock, StageTrack
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction import Profiles

_PULSES_MISSING = 30


class SensorEpoch:
    """The clock of an interval in which sensor time never goes back.

    - ``pulses``: Pulses of the stage, ``None`` when they are not wired to the camera's trigger
      input.

    Public attributes:
    - ``edges_missing``: True after 30 pulses without an edge that fits.
    """

    def __init__(self, clock: SensorClock, pulses: PulseTrain | None) -> None:
        self.clock = clock
        self.edges = EdgeClock(pulses)
        self.edges_missing = False
        self._passed_mm = 0.0
        self._position_mm: float | None = None

    @property
    def expects_edges(self) -> bool:
        """Return whether the clock is fitted to edges of the stage."""
        return self.edges.pulses is not None and not self.clock.exact

    def set_pulses(self, pulses: PulseTrain | None) -> None:
        """Expect other pulses from now on, or none."""
        if pulses != self.edges.pulses:
            self.edges = EdgeClock(pulses)
            self.edges_missing, self._passed_mm = False, 0.0
            self.clock.adopt(None)

    def fit_edges(self, track: StageTrack, *, now: bool = False) -> None:
        """Fit the clock to the edges that are due, with ``now`` to all of them."""
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

    def covers(self, t_us: NDArray[np.int64]) -> bool:
        """Return whether no sensor time is after the last fitted edge; true without edges."""
        if not self.expects_edges:
            return True
        until_us = self.edges.until_us
        return until_us is not None and int(t_us.max()) <= until_us


@dataclass(frozen=True, slots=True)
class SensorTimes:
    """Sensor times of points and of their periods' rising edges, int64 us, within one epoch."""

    epoch: SensorEpoch
    t_us: NDArray[np.int64]
    edge_us: NDArray[np.int64]

    def select(self, mask: NDArray[np.bool_] | NDArray[np.intp] | slice) -> SensorTimes:
        """Return the points where ``mask`` is set, or of a slice."""
        return SensorTimes(self.epoch, self.t_us[mask], self.edge_us[mask])

    def to_ns(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the ROS times by the clock as it is now."""
        return self.epoch.clock.to_ns(self.t_us), self.epoch.clock.to_ns(self.edge_us)


@dataclass(frozen=True, slots=True)
class TimedProfiles:
    """Profiles with int64 ROS nanoseconds of each point and of its period's rising edge.

    ``model`` and ``stage_direction`` are those of their calibration. ``sensor`` holds the sensor
    times while the clock may still improve.
    """

    profiles: Profiles
    t_ns: NDArray[np.int64]
    edge_ns: NDArray[np.int64]
    model: RangeModel
    stage_direction: tuple[float, ...]
    sensor: SensorTimes | None = None

    @classmethod
    def within(
        cls,
        epoch: SensorEpoch,
        profiles: Profiles,
        shift_us: int,
        model: RangeModel,
        stage_direction: tuple[float, ...],
    ) -> TimedProfiles:
        """Return timed profiles; ``shift_us`` is added to their times for the epoch's."""
        sensor = SensorTimes(epoch, profiles.t_us + shift_us, profiles.edge_us + shift_us)
        later = None if epoch.clock.exact else sensor
        return cls(profiles, *sensor.to_ns(), model, stage_direction, later)

    def select(self, mask: NDArray[np.bool_] | slice) -> TimedProfiles:
        """Return the points where ``mask`` is set, or of a slice."""
        if not isinstance(mask, slice) and mask.all():
            return self
        sensor = None if self.sensor is None else self.sensor.select(mask)
        return replace(
            self,
            profiles=self.profiles.select(mask),
            t_ns=self.t_ns[mask],
            edge_ns=self.edge_ns[mask],
            sensor=sensor,
        )

    def retimed(self) -> TimedProfiles:
        """Return the same points with ROS times by the clock as it is now."""
        if self.sensor is None:
            return self
        t_ns, edge_ns = self.sensor.to_ns()
        return replace(self, t_ns=t_ns, edge_ns=edge_ns)

    def latest_ns(self) -> int:
        """Return the ROS time of the last point by the clock as it is now."""
        if self.sensor is None:
            return int(self.t_ns.max())
        return self.sensor.epoch.clock.to_ns(int(self.sensor.t_us.max()))

    @property
    def covered(self) -> bool:
        """Return whether edges cover the times of all points; true without edges."""
        return self.sensor is None or self.sensor.epoch.covers(self.sensor.t_us)
