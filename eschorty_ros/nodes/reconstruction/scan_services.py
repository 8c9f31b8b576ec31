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
from eschorty_ros.nodes.reconstruction.reports import fill_end_scan
from eschorty_ros.nodes.ros.conversions import mm_from_m
from eschorty_ros.srv import BeginScan, EndScan

_CONNECT_S = 3.0
_ASSEMBLE_S = 30.0


class ScanServices:
    """Has the worker begin and end scans; waits for it in a callback group of its own.

    Parameters
    ----------
    node : rclpy.node.Node
    pipeline : Pipeline
        Touched by the worker alone.
    sources : sequence of Subscription
        What a scan cannot do without a publisher of.
    in_worker : callable
        Runs a job in the worker; whether it succeeded, and why not.
    lives : callable
        Whether the worker works.
    stage_timeout_s : float
        For how long points may wait for the stage after the end.
    publish : callable
        Takes a finished scan and the ROS time, ns.
    """

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        sources: Sequence[Subscription],
        in_worker: Callable[[Callable[[], None]], tuple[bool, str]],
        lives: Callable[[], bool],
        stage_timeout_s: float,
        publish: Callable[[AssembledScan, int], None],
    ) -> None:
        self._node, self._pipeline, self._sources = node, pipeline, sources
        self._in_worker, self._lives = in_worker, lives
        self._patience_s = stage_timeout_s + _ASSEMBLE_S
        self._publish = publish
        self._ending: tuple[Callable[[ScanReport], None], ...] = ()
        self._ended_s = 0.0
        group = MutuallyExclusiveCallbackGroup()
        for kind, name, callback in (
            (BeginScan, "reconstruction/begin_scan", self._on_begin),
            (EndScan, "reconstruction/end_scan", self._on_end),
        ):
            node.create_service(kind, name, callback, callback_group=group)

    def finish(self) -> None:
        """Publish the scan that was ended once all its points have their place; in the worker."""
        # Background makes profiles after the light is off, too; nobody waits for those.
        if self._ending and not self._pipeline.placer.holds(self._ended_s):
            callbacks, self._ending = self._ending, ()
            report = self._pipeline.end_scan()
            self._publish(report.scan, self._node.get_clock().now().nanoseconds)
            for callback in callbacks:
                callback(report)

    def _on_begin(self, request: Any, response: Any) -> Any:
        # A publisher may know this node's subscriptions before they know the publisher; whoever
        # begins a scan must be able to rely on every message sent from then on.
        missing = self._unconnected()
        deadline_s = time.monotonic() + _CONNECT_S
        while missing and time.monotonic() < deadline_s and self._lives():
            time.sleep(0.02)
            missing = self._unconnected()
        if missing:
            response.success = False
            response.message = f"nobody publishes {' and '.join(missing)}; start camera and stage"
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
            self._ending = (done,)

        response.success, response.message = self._in_worker(begin_end)
        if not response.success:
            return response
        if not self._awaited(finished):
            response.success = False
            response.message = "the scan was not assembled in time; see the node's log"
            return response
        fill_end_scan(response, reports[0])
        return response

    def _awaited(self, event: threading.Event) -> bool:
        """Wait for the worker's event; after a signal nobody works any more."""
        end_s = time.monotonic() + self._patience_s
        while not event.wait(0.1):
            if time.monotonic() > end_s or not self._lives():
                return event.is_set()
        return True
