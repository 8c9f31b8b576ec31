"""The reconstruction's services ``begin_scan`` and ``end_scan``."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header

from eschorty_ros.control.heartbeat import Sender, read_heartbeat
from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT
from eschorty_ros.core.base.errors import ArgumentError, one_line
from eschorty_ros.core.base.files import bare_name_fault
from eschorty_ros.live.pipeline import Pipeline, ScanReport
from eschorty_ros.live.scan_buffer import AssembledScan
from eschorty_ros.live.scan_recorder import ScanRecorder
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.border import UINT32_MAX, check_text, saturated
from eschorty_ros.nodes.ros.conversions import mm_from_m
from eschorty_ros.nodes.ros.executor import ShortGroup
from eschorty_ros.nodes.ros.peers import OnePublisher
from eschorty_ros.nodes.ros.repeated_call import RESEND_S
from eschorty_ros.nodes.ros.steady_timer import steady_timer
from eschorty_ros.srv import BeginScan, EndScan

_END = "reconstruction/end_scan"
_CHECK_S = 0.2
_CLIENT_TIMEOUT_S = 5.0
_CONNECT_S = 3.0
_WORKER_S = 10.0
_ASSEMBLE_S = 30.0
# A recording that a disk takes longer for goes on without the client.
_RECORD_S = 5.0


class ScanServices:
    """Services that begin and end scans in the worker thread and wait for it.

    - ``pipeline``: Used by the worker alone.
    - ``fault``: Returns why no scan can begin, ``""`` when one can, and whether it may pass.
    - ``in_worker``: Runs a job in the worker; returns whether it succeeded, and the reason of a
      failure.
    - ``running``: Returns whether the worker runs.
    - ``stage_timeout_s``: Longest wait of points for the stage after the end.
    - ``publish``: Publishes a finished scan.
    - ``recorder``: Returns a recorder for a scan's log, ``None`` when scans are not recorded.

    Public attribute ``recordings``: Folders of the scans recorded so far.
    """

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        fault: Callable[[], tuple[str, bool]],
        in_worker: Callable[[Callable[[], None], float], tuple[bool, str]],
        running: Callable[[], bool],
        stage_timeout_s: float,
        publish: Callable[[AssembledScan], None],
        recorder: Callable[[str, float, float, int, float], ScanRecorder | None],
    ) -> None:
        self._node, self._pipeline, self._fault = node, pipeline, fault
        self._in_worker, self._running = in_worker, running
        self._timeout_s = stage_timeout_s + _ASSEMBLE_S
        self._publish = publish
        self._make_recorder = recorder
        self._recorder: ScanRecorder | None = None
        self.recordings: set[Path] = set()
        self._ended: Callable[[ScanReport], None] | None = None
        self._ended_s = 0.0
        self._reason = ""
        self._refused: tuple[Any, Any, float] = None, None, -math.inf
        group = MutuallyExclusiveCallbackGroup()
        for kind, name, callback in (
            (BeginScan, "reconstruction/begin_scan", self._on_begin),
            (EndScan, _END, self._on_end),
        ):
            node.create_service(kind, name, callback, callback_group=group)
        self._client = OnePublisher()
        self._sender: Sender | None = None
        self._begun_s, self._had_client = 0.0, False
        short = ShortGroup()
        node.create_subscription(
            Header, CLIENT_HEARTBEAT, self._on_heartbeat, qos.heartbeat(), callback_group=short
        )
        steady_timer(node, _CHECK_S, self._check_client, short)

    def finish(self) -> None:
        """Publish an ended scan once all its points are placed; called in the worker."""
        # Profiles that arrive later come from the background, without light.
        if self._ended is not None and not self._pipeline.placer.holds(self._ended_s):
            ended, self._ended = self._ended, None
            report = self._pipeline.end_scan(self._reason)
            if report.pass_lag is not None:
                behind = f"points were {report.pass_lag} behind the stage"
                self._node.get_logger().info(f"{behind}; taken off")
            self._publish(report.scan)
            ended(report)

    def _on_begin(self, request: Any, response: Any) -> Any:
        # A request that is repeated while the first one is refused must not begin the scan.
        refused, refusal, at_s = self._refused
        if request == refused and time.monotonic() - at_s < RESEND_S:
            return refusal
        response = self._begin(request, response)
        if not response.success:
            self._refused = request, response, time.monotonic()
        return response

    def _begin(self, request: Any, response: Any) -> Any:
        # A publisher may discover this node's subscriptions before they discover the publisher.
        # After the answer every message sent must arrive.
        response.message, response.retry = self._fault()
        deadline_s = time.monotonic() + _CONNECT_S
        while response.message and time.monotonic() < deadline_s and self._running():
            time.sleep(0.02)
            response.message, response.retry = self._fault()
        scan_id = request.scan_id
        response.message = response.message or bare_name_fault("scan_id", scan_id)
        if response.message:
            return response
        # A request is repeated when its answer is lost.
        if self._pipeline.scan_id == scan_id:
            response.success, response.recording = True, self._folder
            return response
        limits_mm, passes = (mm_from_m(request.start), mm_from_m(request.stop)), request.passes or 1
        speed_mm_s = mm_from_m(request.speed)
        recorder = None
        try:
            recorder = self._make_recorder(scan_id, *limits_mm, passes, speed_mm_s)
        except ArgumentError as error:
            response.message = one_line(str(error))
        if recorder is not None:
            response.message = recorder.made(_RECORD_S)
        if response.message:
            return response
        begin = partial(
            self._pipeline.begin_scan, scan_id, *limits_mm, recorder, passes, speed_mm_s
        )
        response.success, response.message = self._in_worker(begin, _WORKER_S)
        if response.success:
            self._recorder = recorder
            response.recording = self._folder
            if recorder is not None:
                self.recordings.add(recorder.folder)
        elif recorder is not None:
            recorder.end(None, response.message)
        return response

    def end_recording(self) -> None:
        """Write what a scan under way has recorded; called after the worker's end."""
        self._pipeline.end_recording(None, "the node ended during the scan")
        if self._recorder is not None:
            self._recorder.wait(_RECORD_S)

    @property
    def _folder(self) -> str:
        """Return the folder of the scan's recording, ``""`` without one."""
        return "" if self._recorder is None else str(self._recorder.folder)

    def _on_heartbeat(self, message: Header, info: Mapping[str, Any]) -> None:
        self._client.check(info)
        if self._pipeline.scan_id:
            self._sender, _ = read_heartbeat(check_text("frame_id", message.frame_id))

    def _check_client(self) -> None:
        """Publish the points so far of a scan whose client has ended."""
        now_s, scan_id = time.monotonic(), self._pipeline.scan_id
        if not scan_id or self._ended is not None:
            self._sender, self._begun_s, self._had_client = None, now_s, False
            return
        fault = self._sender.fault() if self._sender is not None else ""
        if now_s - self._begun_s > _CLIENT_TIMEOUT_S:
            # A command line's client is there for its one call only.
            clients = self._node.count_clients(self._node.resolve_service_name(_END))
            if self._had_client and not clients:
                fault = "no client is left"
            self._had_client = clients > 0
        if fault:
            self._sender, self._had_client = None, False
            self._node.get_logger().warning(f"{scan_id} was left open ({fault}); ending it")
            self._in_worker(partial(self._end_left_open, scan_id, f"left open ({fault})"), 0.0)

    def _end_left_open(self, scan_id: str, reason: str) -> None:
        # A client that waits for the end may have begun it meanwhile.
        if self._ended is None:
            self._begin_end(scan_id, reason, lambda _: None)

    def _begin_end(self, scan_id: str, reason: str, done: Callable[[ScanReport], None]) -> None:
        self._ended_s = time.monotonic()
        self._pipeline.close_period(scan_id, self._ended_s)
        self._ended = done
        self._reason = reason and f"the scan ended early: {one_line(reason)}"

    def _on_end(self, request: Any, response: Any) -> Any:
        finished = threading.Event()
        reports: list[ScanReport] = []

        def done(report: ScanReport) -> None:
            reports.append(report)
            finished.set()

        end_s = time.monotonic() + self._timeout_s
        response.success, response.message = self._in_worker(
            partial(self._begin_end, request.scan_id, request.reason, done), self._timeout_s
        )
        if not response.success:
            return response
        if not self._awaited(finished, end_s):
            response.success = False
            response.message = (
                f"scan {request.scan_id!r} is not assembled after {self._timeout_s:g} s, its "
                "points come on scan/points later; look at the computer's load"
                if self._running()
                else "the node was shut down"
            )
            return response
        report = reports[0]
        response.profiles = saturated(report.scan.profiles, UINT32_MAX)
        response.points = saturated(len(report.scan.points), UINT32_MAX)
        response.events = saturated(report.events)
        response.packets_lost = saturated(report.packets_lost)
        response.events_dropped = saturated(report.events_dropped)
        response.sigma_median = report.scan.sigma_median_m
        response.completeness = report.completeness
        recorder = self._recorder
        fault = "" if recorder is None else recorder.wait(_RECORD_S)
        response.recording = self._folder
        response.message = "; ".join(text for text in (report.message, fault) if text)
        return response

    def _awaited(self, event: threading.Event, end_s: float) -> bool:
        """Wait for the worker's event; after a signal it may not come."""
        while not event.wait(0.1):
            if time.monotonic() > end_s or not self._running():
                return event.is_set()
        return True
