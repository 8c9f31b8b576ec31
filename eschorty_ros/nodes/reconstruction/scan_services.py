"""The reconstruction's services ``begin_scan`` and ``end_scan``."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription

from eschorty_ros.live.pipeline import Pipeline, ScanReport
from eschorty_ros.live.scan_buffer import AssembledScan
from eschorty_ros.nodes.ros.conversions import mm_from_m
from eschorty_ros.srv import BeginScan, EndScan

_CONNECT_S = 3.0
_ASSEMBLE_S = 30.0


class ScanServices:
    """Services that begin and end scans in the worker thread and wait for it.

    Parameters
    ----------
    node : rclpy.node.Node
    pipeline : Pipeline
        Used by the worker alone.
    sources : sequence of Subscription
        Subscriptions that a scan needs publishers of.
    in_worker : callable
        Runs a job in the worker; returns whether it succeeded, and the reason of a failure.
    running : callable
        Returns whether the worker runs.
    stage_timeout_s : float
        Longest wait of points for the stage after the end.
    publish : callable
        Publishes a finished scan, given the ROS time (ns) for one without points.
    """

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        sources: Sequence[Subscription],
        in_worker: Callable[[Callable[[], None]], tuple[bool, str]],
        running: Callable[[], bool],
        stage_timeout_s: float,
        publish: Callable[[AssembledScan, int], None],
    ) -> None:
        self._node, self._pipeline, self._sources = node, pipeline, sources
        self._in_worker, self._running = in_worker, running
        self._timeout_s = stage_timeout_s + _ASSEMBLE_S
        self._publish = publish
        self._ended: Callable[[ScanReport], None] | None = None
        self._ended_s = 0.0
        group = MutuallyExclusiveCallbackGroup()
        for kind, name, callback in (
            (BeginScan, "reconstruction/begin_scan", self._on_begin),
            (EndScan, "reconstruction/end_scan", self._on_end),
        ):
            node.create_service(kind, name, callback, callback_group=group)

    def finish(self) -> None:
        """Publish an ended scan once all its points are placed; called in the worker."""
        # Profiles that arrive later come from the background, without light.
        if self._ended is not None and not self._pipeline.placer.holds(self._ended_s):
            ended, self._ended = self._ended, None
            report = self._pipeline.end_scan()
            self._publish(report.scan, self._node.get_clock().now().nanoseconds)
            ended(report)

    def _on_begin(self, request: Any, response: Any) -> Any:
        # A publisher may discover this node's subscriptions before they discover the publisher.
        # After the answer every message sent must arrive.
        missing = self._unconnected()
        deadline_s = time.monotonic() + _CONNECT_S
        while missing and time.monotonic() < deadline_s and self._running():
            time.sleep(0.02)
            missing = self._unconnected()
        if missing:
            response.success = False
            response.message = f"no publisher of {' and '.join(missing)}; start camera and stage"
            return response
        begin = partial(
            self._pipeline.begin_scan,
            request.scan_id,
            mm_from_m(request.start),
            mm_from_m(request.stop),
        )
        response.success, response.message = self._in_worker(begin)
        return response

    def _unconnected(self) -> list[str]:
        return [source.topic_name for source in self._sources if not source.get_publisher_count()]

    def _on_end(self, request: Any, response: Any) -> Any:
        finished = threading.Event()
        reports: list[ScanReport] = []

        def done(report: ScanReport) -> None:
            reports.append(report)
            finished.set()

        def begin_end() -> None:
            self._ended_s = time.monotonic()
            self._pipeline.close_period(request.scan_id, self._ended_s)
            self._ended = done

        response.success, response.message = self._in_worker(begin_end)
        if not response.success:
            return response
        if not self._awaited(finished):
            response.success = False
            response.message = "the scan was not assembled in time; see the node's log"
            return response
        report = reports[0]
        response.profiles = report.scan.profiles
        response.points = len(report.scan.points)
        response.events = report.events
        response.packets_lost = report.packets_lost
        response.events_dropped = report.events_dropped
        response.sigma_median = report.scan.sigma_median_m
        response.message = report.message
        return response

    def _awaited(self, event: threading.Event) -> bool:
        """Wait for the worker's event; after a signal it may not come."""
        end_s = time.monotonic() + self._timeout_s
        while not event.wait(0.1):
            if time.monotonic() > end_s or not self._running():
                return event.is_set()
        return True
