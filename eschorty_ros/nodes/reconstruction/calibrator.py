"""The ``calibrate`` action: capture the targets, find them, fit a calibration, use it."""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from eschorty_ros.action import Calibrate
from eschorty_ros.control.calibration_sequence import check_request, run_capture
from eschorty_ros.control.scan_sequence import End
from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.core.calibration import AggregateFrame, calibrate
from eschorty_ros.live.calibration_capture import (
    Capture,
    CaptureRequest,
    Findings,
    enough_targets,
    make_capture,
)
from eschorty_ros.nodes.reconstruction.active_calibration import ActiveCalibration
from eschorty_ros.nodes.reconstruction.calibration_messages import fill_result, request_from_goal
from eschorty_ros.nodes.ros.cloud_messages import image_message
from eschorty_ros.nodes.ros.instrument_client import InstrumentClient, end_goal
from eschorty_ros.nodes.ros.spin import unless_shut_down

_FEEDBACK_S = 0.2
_SEARCH_S = 0.5
_COPY_TIMEOUT_S = 2.0
_SEARCH_JOIN_S = 5.0
_WORKER_TIMEOUT_S = 30.0

InWorker = Callable[[Callable[[], None], float], tuple[bool, str]]


class Calibrator:
    """Runs one calibration at a time.

    A goal that cannot be done is accepted and aborted at once, because only a result can carry
    the reason to the client.

    - ``node``: The reconstruction node.
    - ``in_worker``: Runs a job in the reconstruction's worker within a time, or with 0 at any later
      time; returns success and the reason of a failure.
    - ``set_capture``: Sets the capture to feed, or ``None``; called in the worker. Raises an
      ``EschortyError`` when that is refused.
    - ``line_width_px``: Returns the width of the line in the node's settings.
    - ``frame``: Name of the frame of the picture.
    - ``timeouts_s``: Those of ``InstrumentClient``.
    """

    def __init__(
        self,
        node: Node,
        active: ActiveCalibration,
        in_worker: InWorker,
        set_capture: Callable[[Capture | None], None],
        line_width_px: Callable[[], float],
        frame: str,
        timeouts_s: tuple[float, float, float],
    ) -> None:
        self._node = node
        self._active = active
        self._nominal = active.calibration
        self._in_worker = in_worker
        self._set_capture = set_capture
        self._line_width_px = line_width_px
        self._frame = frame
        # Before the node spins: rclpy's action client must not be made while an executor uses it.
        self._client = InstrumentClient(node, *timeouts_s)
        self._one = threading.Lock()
        self._idle = threading.Event()
        self._idle.set()
        self._server = ActionServer(
            node,
            Calibrate,
            "calibrate",
            execute_callback=self._execute,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def safe_state(self) -> None:
        """End a capture under way: on its way out the laser goes off and its heartbeat stops."""
        self._client.end()
        self._idle.wait(2.0)

    def _execute(self, goal: Any) -> Any:
        try:
            # First: a goal that is refused must not hold up another one.
            request = request_from_goal(goal.request)
            check_request(request)
        except EschortyError as error:
            return self._refuse(goal, str(error))
        if not self._one.acquire(blocking=False):
            return self._refuse(goal, "a calibration is running; wait for its end or cancel it")
        self._idle.clear()
        try:
            with unless_shut_down(self._node):
                return self._calibrate(goal, request)
            return Calibrate.Result(message="the node was shut down")
        except EschortyError as error:
            return self._refuse(goal, str(error))
        finally:
            self._idle.set()
            self._one.release()

    def _calibrate(self, goal: Any, request: CaptureRequest) -> Any:
        capture = make_capture(request, self._nominal, self._line_width_px())
        client = self._client
        feedback = _Feedback(goal, request, capture, self._in_worker, client)
        client.prepare(lambda: bool(goal.is_cancel_requested), feedback.send)
        outcome = run_capture(
            client, request, lambda: self._feed(capture), lambda: self._feed(None)
        )
        result = Calibrate.Result(message=outcome.message)
        if not self._node.context.ok():
            return result
        now_ns = self._node.get_clock().now().nanoseconds
        result.frame = image_message(capture.frame.image(), now_ns, self._frame)
        if outcome.end is End.SUCCEEDED:
            try:
                feedback.send("fitting")
                findings = capture.find(capture.frame)
                feedback.show(findings, capture.frame.events)
                self._fit(findings, request, result)
                if capture.packets_lost:
                    result.verdicts = [
                        *result.verdicts,
                        f"{capture.packets_lost} packets of events were lost",
                    ]
            except EschortyError as error:
                outcome.end, result.message = End.ABORTED, str(error)
        return self._closed(goal, outcome.end, result)

    def _fit(self, findings: Findings, request: CaptureRequest, result: Any) -> None:
        result.rejected = list(findings.rejected)
        targets = enough_targets(findings, len(request.targets))
        date = datetime.now(UTC).date().isoformat()
        report = calibrate(targets, self._nominal, request.method, date=date)  # type: ignore[arg-type]
        file = self._active.store(report.calibration, targets)
        fill_result(result, report, file)

    def _closed(self, goal: Any, end: End, result: Any) -> Any:
        result.success = end is End.SUCCEEDED
        end_goal(goal, end)
        if result.success:
            self._node.get_logger().info(
                f"calibrated on {len(result.ranges)} targets, residual {result.residual_rms:.2f} "
                f"px; {'; '.join(result.verdicts)}"
            )
        elif end is End.ABORTED:
            self._node.get_logger().error(f"calibration failed: {result.message}")
        return result

    def _refuse(self, goal: Any, reason: str) -> Any:
        self._node.get_logger().error(f"calibration refused: {reason}")
        goal.abort()
        return Calibrate.Result(success=False, message=reason)

    def _feed(self, capture: Capture | None) -> None:
        feed = partial(self._set_capture, capture)
        done, reason = self._in_worker(feed, _WORKER_TIMEOUT_S)
        if not done:
            if capture is None:
                # Until the capture has ended no scan can begin.
                self._in_worker(feed, 0.0)
            raise DeviceError(f"reconstruction: {reason}")


class _Feedback:
    """The targets found in copies of a capture's frame while the capture lasts."""

    def __init__(
        self,
        goal: Any,
        request: CaptureRequest,
        capture: Capture,
        in_worker: InWorker,
        client: InstrumentClient,
    ) -> None:
        self._client = client
        self._goal = goal
        self._request = request
        self._capture = capture
        self._in_worker = in_worker
        self._begun_s = self._sent_s = self._searched_s = time.monotonic()
        self._message = Calibrate.Feedback()
        # In another thread than the sequence, which has to tick for the laser's heartbeat.
        self._search = threading.Thread(target=self._find, daemon=True)

    def send(self, phase: str) -> None:
        """Publish the state when it is due; start a new search when that is due."""
        now_s = time.monotonic()
        if phase == self._message.phase and now_s - self._sent_s < _FEEDBACK_S:
            return
        message = self._message
        if phase == "capturing" != message.phase:
            self._begun_s = self._searched_s = now_s
        self._sent_s = now_s
        message.phase = phase
        message.waits_for = self._client.waits_for
        if phase == "capturing":
            share = (now_s - self._begun_s) / self._expected_s()
            message.progress = min(max(share, 0.0), 1.0)
            if now_s - self._searched_s >= _SEARCH_S and not self._search.is_alive():
                self._searched_s = now_s
                self._search = threading.Thread(target=self._find, daemon=True)
                self._search.start()
        elif phase in ("finishing", "fitting"):
            message.progress = 1.0
        self._goal.publish_feedback(message)

    def _find(self) -> None:
        copies: list[AggregateFrame] = []
        self._in_worker(lambda: copies.append(copy.deepcopy(self._capture.frame)), _COPY_TIMEOUT_S)
        if not copies:
            return
        try:
            findings = self._capture.find(copies[0])
        except EschortyError:
            # An incomplete frame may be ambiguous.
            findings = Findings()
        self._note(findings, copies[0].events)

    def show(self, findings: Findings, events: int) -> None:
        """Publish the targets found in the complete capture."""
        if self._search.is_alive():
            self._search.join(_SEARCH_JOIN_S)
        self._note(findings, events)
        self._goal.publish_feedback(self._message)

    def _note(self, findings: Findings, events: int) -> None:
        self._message.events = events
        self._message.posts = findings.posts
        self._message.matched = len(findings.targets) if findings.targets is not None else 0
        self._message.residuals = findings.residual_px.tolist()

    def _expected_s(self) -> float:
        sweep = self._request.sweep
        if sweep is None:
            return self._request.capture_s
        return 2.0 * abs(sweep.stop_mm - sweep.start_mm) / sweep.speed_mm_s
