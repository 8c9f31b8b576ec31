"""The clouds and the event image that the reconstruction publishes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction import LIVE_SPAN_NS, live_points, place_link
from eschorty_ros.core.storage import height_map, join_points
from eschorty_ros.live.event_frame import EventFrame
from eschorty_ros.live.scan_buffer import AssembledScan, PlacedPoints
from eschorty_ros.live.sensor_epoch import TimedProfiles
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.cloud_messages import cloud_message, image_message, serialized_cloud
from eschorty_ros.nodes.ros.frames import Frames

POINTS_INTERVAL_S = 0.05
_FRAME_INTERVAL_S = 0.1


class Outputs:
    """Publishers of the reconstruction node; messages without a subscriber are not built.

    Only the worker thread calls the methods, except the constructor.

    - ``profile_rate_max_hz``: Profiles per second of sensor time that are published at most.
    - ``names``: Those of the frames.
    """

    def __init__(
        self, node: Node, calibration: Calibration, profile_rate_max_hz: float, names: Frames
    ) -> None:
        self._node, self._columns, self._rows = node, calibration.columns, calibration.rows
        self._names = names
        self._profile_spacing_ns = round(1e9 / profile_rate_max_hz)
        override = {"qos_overriding_options": qos.overridable()}
        self._profile = node.create_publisher(PointCloud2, "profile", qos.stream(10), **override)
        self._points = node.create_publisher(PointCloud2, "points", qos.stream(50), **override)
        self._scan = node.create_publisher(PointCloud2, "scan/points", qos.latched())
        self._image = node.create_publisher(Image, "event_frame", qos.stream(2), **override)
        self._last_profile_ns = -(1 << 62)
        self._batch: list[PlacedPoints] = []
        self._points_at_s = 0.0
        self._frame: EventFrame | None = None
        self._frame_at_s = 0.0

    @property
    def waits(self) -> bool:
        """Return whether points or an image wait until they are due."""
        return bool(self._batch) or self._frame is not None

    @property
    def points_due(self) -> bool:
        """Return whether points that come now need not wait."""
        return time.monotonic() - self._points_at_s >= POINTS_INTERVAL_S

    def packet(self, data: Any) -> None:
        """Add a packet to the event image if it has a subscriber."""
        if self._image.get_subscription_count() == 0:
            self._frame = None
            return
        if self._frame is None:
            self._frame = EventFrame(self._columns, self._rows)
        self._frame.push(data)

    def event_frame(self, stamp_ns: int) -> None:
        """Publish the event image when it is due."""
        now_s = time.monotonic()
        if self._frame is not None and now_s - self._frame_at_s >= _FRAME_INTERVAL_S:
            self._frame_at_s = now_s
            self._image.publish(image_message(self._frame.render(), stamp_ns, self._names.optical))

    def profiles(self, fresh: list[TimedProfiles]) -> None:
        """Publish each profile, or as many as the maximum rate allows."""
        if not fresh or self._profile.get_subscription_count() == 0:
            return
        for timed in fresh:
            for profile in self._spaced(timed):
                stamp_ns = int(profile.t_ns.min())
                points = place_link(profile.profiles, profile.model)
                live = live_points(points, profile.t_ns, stamp_ns)
                self._profile.publish(serialized_cloud([live], stamp_ns, self._names.link))

    def _spaced(self, timed: TimedProfiles) -> Iterator[TimedProfiles]:
        """Yield each profile that the maximum rate allows."""
        edge_ns = timed.edge_ns
        starts = np.flatnonzero(edge_ns[1:] != edge_ns[:-1]) + 1
        for begin, end in pairwise([0, *starts.tolist(), edge_ns.size]):
            begun_ns = int(edge_ns[begin])
            if abs(begun_ns - self._last_profile_ns) >= self._profile_spacing_ns:
                self._last_profile_ns = begun_ns
                yield timed.select(slice(begin, end))

    def points(self, placed: list[PlacedPoints]) -> None:
        """Collect points and publish them as one cloud at most every 50 ms."""
        self._batch.extend(placed)
        if not self._batch or not self.points_due:
            return
        # One that is late does not delay the next one.
        now_s, due_s = time.monotonic(), self._points_at_s + POINTS_INTERVAL_S
        self._points_at_s = due_s if now_s < due_s + POINTS_INTERVAL_S else now_s
        if self._points.get_subscription_count() == 0:
            self._batch.clear()
            return
        parts = [(part.points, part.t_ns) for part in self._batch if len(part)]
        self._batch.clear()
        if len({points.dtype for points, _ in parts}) > 1:
            joined = join_points([points for points, _ in parts])
            parts = [(joined, np.concatenate([t_ns for _, t_ns in parts]))]
        while parts:
            stamp_ns = min(int(t_ns.min()) for _, t_ns in parts)
            live, left = [], []
            for points, t_ns in parts:
                later = t_ns >= stamp_ns + LIVE_SPAN_NS
                if later.any():
                    left.append((points[later], t_ns[later]))
                    points, t_ns = points[~later], t_ns[~later]
                live.append(live_points(points, t_ns, stamp_ns))
            self._points.publish(serialized_cloud(live, stamp_ns, self._names.base))
            parts = left

    def scan(self, scan: AssembledScan, organized: bool) -> None:
        """Publish an assembled scan, ``organized`` as a height map; an empty one replaces none."""
        points = scan.points
        if not len(points):
            return
        if organized:
            try:
                points = height_map(points, scan.edge_ns, self._columns)
            except ArgumentError as error:
                # The parameter returns was changed during the scan.
                self._node.get_logger().warning(f"scan/points is not organized: {error}")
        self._scan.publish(cloud_message(points, scan.stamp_ns, self._names.base))
