"""The points of one scan, collected and put in order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.storage import POINT_DTYPE, join_points
from eschorty_ros.core.storage.recording import between
from eschorty_ros.live.sensor_epoch import SensorTimes


@dataclass(frozen=True, slots=True)
class PlacedPoints:
    """Points in the static frame with the times and positions that sort them; one entry each.

    ``points`` is as ``place`` returns it, its ``t`` unused. ``t_ns`` and ``edge_ns`` are int64 ROS
    nanoseconds of the point and of the rising edge of its period, ``stage_mm`` is float64.
    ``sensor`` holds the sensor times while the clock may still improve.
    """

    points: NDArray[Any]
    t_ns: NDArray[np.int64]
    edge_ns: NDArray[np.int64]
    stage_mm: NDArray[np.float64]
    sensor: SensorTimes | None = None

    def __len__(self) -> int:
        return len(self.points)

    def select(self, mask: NDArray[Any]) -> PlacedPoints:
        """Return the points at ``mask``: booleans or indices."""
        return PlacedPoints(
            self.points[mask],
            self.t_ns[mask],
            self.edge_ns[mask],
            self.stage_mm[mask],
            None if self.sensor is None else self.sensor.select(mask),
        )


@dataclass(frozen=True, slots=True)
class AssembledScan:
    """Points sorted by period, then column; ``t`` in seconds since ``stamp_ns``.

    ``edge_ns`` is the rising edge of each point's period.
    """

    points: NDArray[Any]
    edge_ns: NDArray[np.int64]
    stamp_ns: int
    profiles: int
    sigma_median_m: float


class ScanBuffer:
    """Points whose stage position is between two limits.

    Points whose position is not final are all kept until the end.

    - ``start_mm``, ``stop_mm``: Limits of the stage position, both included, in either order.
    - ``since_ns``: Points of periods that begin before this ROS time are left out.
    - ``points_max``: Points above this number are left out.

    Public attributes:
    - ``points_outside``, ``points_over_limit``: Points left out because they are not between the
      limits or of before, or were too many.

    Raises ``ArgumentError`` when a limit is not finite or the identifier is empty.
    """

    def __init__(
        self,
        scan_id: str,
        start_mm: float,
        stop_mm: float,
        since_ns: int | None = None,
        points_max: int = 40_000_000,
    ) -> None:
        if not scan_id:
            raise ArgumentError("scan_id is empty; give the scan a name")
        if not (np.isfinite(start_mm) and np.isfinite(stop_mm)):
            raise ArgumentError(
                f"start {start_mm!r} mm or stop {stop_mm!r} mm is not finite; give both"
            )
        self.scan_id = scan_id
        self.points_outside = self.points_over_limit = 0
        self._limits_mm = start_mm, stop_mm
        self._since_ns = -(1 << 62) if since_ns is None else since_ns
        self._points_max = points_max
        self._parts: list[PlacedPoints] = []
        self._count = 0

    def add(self, placed: PlacedPoints) -> None:
        """Keep the points between the limits."""
        begun = placed.edge_ns >= self._since_ns
        if not begun.all():
            self.points_outside += int(np.count_nonzero(~begun))
            placed = placed.select(begun)
        kept = placed if placed.sensor is not None else self._inside(placed)
        room = self._points_max - self._count
        if len(kept) > room:
            self.points_over_limit += len(kept) - room
            kept = kept.select(np.arange(room))
        if len(kept):
            self._parts.append(kept)
            self._count += len(kept)

    def _inside(self, placed: PlacedPoints) -> PlacedPoints:
        inside = between(placed.stage_mm, *self._limits_mm)
        self.points_outside += int(np.count_nonzero(~inside))
        return placed if inside.all() else placed.select(inside)

    def assemble(
        self, placed_again: Callable[[PlacedPoints], PlacedPoints] | None = None
    ) -> AssembledScan:
        """Return all kept points as one cloud, which may be empty.

        ``placed_again`` returns points at their final position.
        """
        if placed_again is not None:
            self._parts = [self._inside(placed_again(part)) for part in self._parts]
        self._parts = [part for part in self._parts if len(part)]
        if not self._parts:
            return AssembledScan(
                np.empty(0, POINT_DTYPE), np.empty(0, np.int64), 0, 0, float("nan")
            )
        points = join_points([part.points for part in self._parts])
        t_ns = np.concatenate([part.t_ns for part in self._parts])
        edge_ns = np.concatenate([part.edge_ns for part in self._parts])
        stamp_ns = int(t_ns.min())
        points["t"] = (t_ns - stamp_ns) * 1e-9
        order = np.lexsort((points["column"], edge_ns))
        return AssembledScan(
            points[order],
            edge_ns[order],
            stamp_ns,
            len(np.unique(edge_ns)),
            float(np.median(points["sigma"])),
        )
