"""Node ``viewer``: the instrument's topics on a page in the browser."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image, PointCloud2

from eschorty_ros.action import Scan
from eschorty_ros.core.base.errors import ArgumentError, one_line
from eschorty_ros.msg import LaserState, ReconstructionState
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.border import check_text
from eschorty_ros.nodes.ros.cloud_messages import points_from_message
from eschorty_ros.nodes.ros.conversions import m_from_mm
from eschorty_ros.nodes.ros.parameters import Param, Parameters
from eschorty_ros.nodes.ros.spin import run, unless_shut_down
from eschorty_ros.nodes.ros.steady_timer import steady_timer
from eschorty_ros.viewer.growing_cloud import GrowingCloud
from eschorty_ros.viewer.page import HOST, PORT, Page
from eschorty_ros.viewer.scan_control import Conditions, ScanControl, ScanValues
from eschorty_ros.viewer.status import Status, laser_text

TABLE = (
    Param("host", HOST, "address that the page is served on; another than 127.0.0.1 opens it to "
          "the network"),
    Param("port", PORT, "port of the page", "", 1, 65535),
    Param("allow_scan", False, "the page may start scans, with the code that the log shows"),
)  # fmt: skip

_SHOW_S = 0.4
_REPORT_TIMEOUT_S = 2.0
# The scanner sends feedback ten times a second.
_SCANNER_TIMEOUT_S = 10.0
_COUNTS = (
    "profiles", "points", "packets_lost", "events_dropped", "sensor_drop_words",
    "points_without_stage",
)  # fmt: skip


class ViewerNode(Node):
    """Shows points, profile, events and states; starts and cancels scans like any other client."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("viewer", **kwargs)
        self.parameters = Parameters(self, TABLE)
        self._cloud = GrowingCloud()
        self._control = ScanControl(self.parameters["allow_scan"])
        self.page = Page(
            self._cloud, self._control, self.parameters["host"], self.parameters["port"]
        )
        self._status = Status()
        self._laser_s = self._reconstruction_s = float("-inf")
        self._interlock_open = True
        self._handle: Any = None
        self._cancel_wanted = False
        self._scanner_s = float("-inf")
        self._record_before: str | None = None
        self._frame: Any = None
        self._profile: Any = None
        group = MutuallyExclusiveCallbackGroup()
        for kind, topic, callback, profile in (
            (PointCloud2, "points", self._on_points, qos.stream(50)),
            (PointCloud2, "scan/points", self._on_scan, qos.latched()),
            (PointCloud2, "profile", self._on_profile, qos.stream(2)),
            (Image, "event_frame", self._on_frame, qos.stream(2)),
            (LaserState, "laser/state", self._on_laser, qos.latched(qos.STATE_HISTORY)),
            (ReconstructionState, "reconstruction/state", self._on_state, 10),
        ):
            self.create_subscription(kind, topic, callback, profile, callback_group=group)
        self._scan = ActionClient(self, Scan, "scan", callback_group=group)
        self._get_parameters, self._set_parameters = (
            self.create_client(kind, f"reconstruction/{name}", callback_group=group)
            for kind, name in ((GetParameters, "get_parameters"), (SetParameters, "set_parameters"))
        )
        steady_timer(self, _SHOW_S, self._show, MutuallyExclusiveCallbackGroup())
        code = f", code {self._control.code} to start scans" if self._control.allowed else ""
        self.get_logger().info(f"page at {self.page.url}{code}")

    def safe_state(self) -> None:
        """Cancel a scan of the page; the scanner switches the laser off also without it."""
        self._cancel_wanted = True
        with unless_shut_down(self):
            self._release()
        self.page.stop()

    def _release(self) -> None:
        """Cancel the page's scan, if there is one, and restore what it has set."""
        handle, self._handle = self._handle, None
        before, self._record_before = self._record_before, None
        if handle is not None:
            handle.cancel_goal_async()
        if before is not None:
            self._set_record(before)

    def _on_points(self, message: PointCloud2) -> None:
        self._cloud.add(_points(message))

    def _on_scan(self, message: PointCloud2) -> None:
        points = _points(message)
        self._cloud.clear()
        self._cloud.add(points)

    def _on_profile(self, message: PointCloud2) -> None:
        points = _points(message)
        known = np.isfinite(points["x"]) & np.isfinite(points["z"])
        z, x = (points[axis][known].astype(np.float64) * 1e3 for axis in "zx")
        self._profile = z, x

    def _on_frame(self, message: Image) -> None:
        if message.encoding != "mono8" or len(message.data) != message.height * message.width:
            raise ArgumentError("event_frame is not mono8 of height times width; send that")
        self._frame = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width)

    def _on_laser(self, message: LaserState) -> None:
        self._laser_s = time.monotonic()
        self._interlock_open = bool(message.interlock_open)
        self._status.laser = laser_text(message.output, message.armed)
        self._status.reason = one_line(message.reason)

    def _on_state(self, message: ReconstructionState) -> None:
        self._reconstruction_s = time.monotonic()
        self._status.events_per_second = float(message.events_per_second)
        self._status.counts = {name: int(getattr(message, name)) for name in _COUNTS}
        scan_id = check_text("scan_id", message.scan_id)
        if scan_id and scan_id != self._status.scan_id:
            self._cloud.clear()
        self._status.scan_id = scan_id

    def _conditions(self) -> Conditions:
        return Conditions(
            scanner=self._scan.server_is_ready(),
            scanning=bool(self._status.scan_id) or self._control.under_way,
            laser=time.monotonic() - self._laser_s < _REPORT_TIMEOUT_S,
            interlock_open=self._interlock_open,
        )

    def _show(self) -> None:
        asked, cancel = self.page.requests()
        if asked is not None:
            try:
                self._begin(self._control.start(*asked, self._conditions()))
            except ArgumentError as error:
                self._status.message = f"not started: {error}"
        self._check_scanner()
        if cancel and not self._control.under_way:
            self._status.message = "no scan of this page is under way"
        self._cancel_wanted |= cancel or self._control.abandoned(self.page.pages)
        if self._handle is not None and self._cancel_wanted:
            self._handle.cancel_goal_async()
        now_s = time.monotonic()
        if now_s - self._laser_s >= _REPORT_TIMEOUT_S:
            self._status.laser, self._status.reason = "no report", ""
        if now_s - self._reconstruction_s >= _REPORT_TIMEOUT_S:
            self._status.events_per_second, self._status.counts = math.nan, {}
            self._status.scan_id = ""
        profile, self._profile = self._profile, None
        frame, self._frame = self._frame, None
        self.page.show(self._status.markdown, profile, frame)

    def _check_scanner(self) -> None:
        """Give up a scan whose scanner is gone; another one may have come in its place."""
        age_s = time.monotonic() - self._scanner_s
        if self._control.under_way and age_s > _SCANNER_TIMEOUT_S:
            # One that has only stalled goes on with its goal.
            self._release()
            self._end("the scanner does not answer; start another scan when it is there again")

    def _end(self, message: str) -> None:
        """Take note of the end of the page's scan."""
        self._handle = None
        self._control.ended()
        self._status.phase, self._status.message = "", message
        self._release()

    def _begin(self, values: ScanValues) -> None:
        # The browser may drop a change that is followed by the click within 50 ms.
        self._status.message, self._scanner_s = f"requested: {values}", time.monotonic()
        self._cancel_wanted = False
        goal = Scan.Goal(
            start=m_from_mm(values.start_mm),
            stop=m_from_mm(values.stop_mm),
            speed=m_from_mm(values.speed_mm_s),
            frequency=float(values.frequency_hz),
            duty=float(values.duty),
            passes=values.passes,
        )
        if not values.record:
            self._send(goal)
            return
        if not self._get_parameters.service_is_ready():
            self._end("not started: no reconstruction to record; start its node")
            return

        def on_value(future: Any) -> None:
            if not self._control.under_way:
                return
            self._record_before = future.result().values[0].string_value
            self._set_record(values.record).add_done_callback(on_set)

        def on_set(future: Any) -> None:
            [answer] = future.result().results
            if answer.successful:
                self._send(goal)
            else:
                self._end(f"not started: {answer.reason}")

        asked = self._get_parameters.call_async(GetParameters.Request(names=["record"]))
        asked.add_done_callback(on_value)

    def _set_record(self, folder: str) -> Any:
        """Set the folder into which the reconstruction records."""
        request = SetParameters.Request()
        request.parameters = [Parameter("record", value=folder).to_parameter_msg()]
        return self._set_parameters.call_async(request)

    def _send(self, goal: Any) -> None:
        if not self._control.under_way:
            return
        if self._cancel_wanted:
            self._end("canceled before it began")
            return
        self._scan.send_goal_async(goal, feedback_callback=self._on_feedback).add_done_callback(
            self._on_answer
        )

    def _on_answer(self, future: Any) -> None:
        handle = future.result()
        if not self._control.under_way:
            handle.cancel_goal_async()
            return
        if not handle.accepted:
            self._end("not started: the scanner refused the goal")
            return
        self._handle = handle
        if self._cancel_wanted:
            handle.cancel_goal_async()
        handle.get_result_async().add_done_callback(lambda ended: self._on_result(handle, ended))

    def _on_feedback(self, message: Any) -> None:
        self._scanner_s = time.monotonic()
        state = message.feedback
        self._status.phase = one_line(state.waits_for or state.phase)
        self._status.progress = float(state.progress)

    def _on_result(self, handle: Any, future: Any) -> None:
        if handle is not self._handle:
            return
        result = future.result().result
        recorded = f"recorded into {result.recording}" if result.recording else ""
        counted = f"{result.verdict}, {result.points:,} points"
        self._end("; ".join(text for text in (counted, result.message, recorded) if text))


def _points(message: PointCloud2) -> Any:
    try:
        return points_from_message(message)
    except (KeyError, ValueError, TypeError) as error:
        raise ArgumentError(f"a cloud is malformed ({error}); send x y z and sigma") from error


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; ``args`` are those of the process when omitted."""
    return run(ViewerNode, threads=3, args=args)


if __name__ == "__main__":
    sys.exit(main())
