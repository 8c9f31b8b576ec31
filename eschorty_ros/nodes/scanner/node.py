"""Node ``scanner``: the ``scan`` action over laser, stage and reconstruction."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from eschorty_ros.action import Scan
from eschorty_ros.control.scan_sequence import (
    SPEED_MIN_MM_S,
    End,
    ScanFailure,
    ScanOutcome,
    ScanRequest,
    ScanSettings,
    SweepProgress,
    check_request,
    crossing_ns,
    run_scan,
)
from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ
from eschorty_ros.live.sweep_coverage import PASSES_MAX
from eschorty_ros.nodes.ros import diagnostics
from eschorty_ros.nodes.ros.conversions import m_from_mm, mm_from_m, stamp_from_ns
from eschorty_ros.nodes.ros.instrument_client import ScanClient, end_goal
from eschorty_ros.nodes.ros.parameters import Param, Parameters
from eschorty_ros.nodes.ros.spin import ends, run, unless_shut_down
from eschorty_ros.nodes.ros.steady_timer import steady_timer

_SPEED_MIN = m_from_mm(SPEED_MIN_MM_S)

TABLE = (
    Param("auto_scan", False, "do one scan as soon as the other nodes are ready"),
    Param("start", 0.01, "auto_scan: stage position where the sweep begins", "m", -1.0, 1.0),
    Param("stop", 0.06, "auto_scan: stage position where it ends", "m", -1.0, 1.0),
    Param("speed", 0.05, "auto_scan: stage speed", "m/s", _SPEED_MIN, 1.0),
    Param("frequency", 0.0, "auto_scan: modulation frequency; 0 keeps the laser's", "Hz",
          0.0, FREQUENCY_MAX_HZ),
    Param("duty", 0.0, "auto_scan: duty; 0 keeps the laser's", "", 0.0, 0.999),
    Param("passes", 1, "auto_scan: sweeps back and forth", "", 1, PASSES_MAX),
    Param("approach_speed", 0.1, "speed towards the start", "m/s", _SPEED_MIN, 1.0),
    # Without `eschorty compile` the nodes of a first run answer later still.
    Param("node_timeout", 60.0, "longest wait for the other nodes", "s", 0.1, 600.0),
    Param("service_timeout", 5.0, "longest wait for an answer", "s", 0.1, 60.0),
    Param("events_timeout", 3.0, "longest pause of the events while the laser is on", "s",
          0.1, 60.0),
    Param("completeness_min", 0.9, "share of profiles, packets and points below which a scan fails",
          "", 0.0, 1.0),
    Param("drain_timeout", 10.0, "longest pause of the reconstruction after the sweep", "s",
          0.1, 600.0),
)  # fmt: skip

_FEEDBACK_S = 0.1
_COUNT_CLIENTS_S = 0.5
# A client that has just been discovered may not be counted yet.
_CLIENT_TIMEOUT_S = 5.0
# The next goal waits for the end of a canceled one.
_CANCELED_S = 10.0
# Time for the other nodes to start before a missing one is logged.
_STARTING_S = 5.0


class ScannerNode(Node):
    """Runs one scan at a time.

    A goal that cannot be done is accepted and aborted at once, because only a result can carry
    the reason to the client.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("scanner", **kwargs)
        self.parameters = Parameters(self, TABLE)
        self._settings = ScanSettings(
            approach_mm_s=mm_from_m(self.parameters["approach_speed"]),
            drain_timeout_s=self.parameters["drain_timeout"],
            completeness_min=self.parameters["completeness_min"],
        )
        self._client = ScanClient(
            self,
            self.parameters["node_timeout"],
            self.parameters["service_timeout"],
            self.parameters["events_timeout"],
        )
        self._client.subscribe()
        self._one_scan = threading.Lock()
        self._idle = threading.Event()
        self._idle.set()
        self._scans = 0
        self._client_seen_s = self._clients_counted_s = 0.0
        self._last = "no scan yet"
        self.waiting = ""
        self._begun_s = time.monotonic()
        group = ReentrantCallbackGroup()
        self._server = ActionServer(
            self,
            Scan,
            "scan",
            execute_callback=self._execute,
            cancel_callback=self._on_cancel,
            callback_group=group,
        )
        diagnostics.Diagnostics(self, self._report, group)
        self._own_goal = self._running_goal = self._canceled_goal = b""
        if self.parameters["auto_scan"]:
            self._self_client = ActionClient(self, Scan, "scan", callback_group=group)
            self._auto_timer = steady_timer(self, 0.1, self._auto_scan, group)

    def safe_state(self) -> None:
        """End a scan under way: on its way out the laser goes off and its heartbeat stops."""
        self._client.end()
        self._idle.wait(2.0)

    def _on_cancel(self, goal: Any) -> CancelResponse:
        self._canceled_goal = bytes(goal.goal_id.uuid)
        return CancelResponse.ACCEPT

    def _execute(self, goal: Any) -> Any:
        values = goal.request
        # Units of one graph may record into the same folder.
        unique = bytes(goal.goal_id.uuid[:4]).hex()
        request = ScanRequest(
            scan_id=time.strftime("scan-%Y%m%d-%H%M%S-", time.gmtime()) + unique,
            start_mm=mm_from_m(values.start),
            stop_mm=mm_from_m(values.stop),
            speed_mm_s=mm_from_m(values.speed),
            frequency_hz=float(values.frequency),
            duty=float(values.duty),
            passes=values.passes or 1,
        )
        try:
            # First: a goal that is refused must not hold up another one.
            if (limits := self._client.monitor.limits) is not None:
                check_request(request, limits)
        except EschortyError as error:
            return self._refuse(goal, str(error))
        ends_s = _CANCELED_S if self._canceled_goal == self._running_goal else 0.0
        if not self._one_scan.acquire(timeout=ends_s):
            return self._refuse(goal, "a scan is running; wait for its end or cancel it")
        self._running_goal = bytes(goal.goal_id.uuid)
        self._idle.clear()
        try:
            return self._scan(goal, request)
        finally:
            self._idle.set()
            self._one_scan.release()

    def _scan(self, goal: Any, request: ScanRequest) -> Any:
        self._scans += 1
        self._client_seen_s = time.monotonic()
        self._client.prepare(partial(self._canceled, goal), self._feedback(goal, request))
        outcome = run_scan(self._client, request, self._settings)
        result = self._result(request, outcome)
        details = result.message.removeprefix(End.CANCELED.value).removeprefix("; ")
        self._last = f"{request.scan_id}: {outcome.end.value}" + (details and f": {details}")
        if ends(self):
            with unless_shut_down(self):
                goal.abort()
            return result
        line = f"{self._last}; {result.points} points"
        # Two calls: rclpy's logger refuses a call site that changes its severity.
        if outcome.end is End.ABORTED:
            self.get_logger().error(line)
        else:
            self.get_logger().info(line)
        with unless_shut_down(self):
            end_goal(goal, outcome.end)
        return result

    def _canceled(self, goal: Any) -> bool:
        """Return whether the goal is canceled; ``ScanFailure`` when no client is left."""
        now_s = time.monotonic()
        # Counted first: nothing is, while a scan begins or this process stalls.
        if now_s - self._clients_counted_s > _COUNT_CLIENTS_S:
            self._clients_counted_s = now_s
            own = bytes(goal.goal_id.uuid) == self._own_goal
            clients = self.count_clients(f"{self.resolve_service_name('scan')}/_action/get_result")
            # The node's own client asks for no other goal.
            if clients > (bool(self._own_goal) and not own):
                self._client_seen_s = now_s
        if now_s - self._client_seen_s > _CLIENT_TIMEOUT_S:
            raise ScanFailure("scanner: no client of the scan is left; the scan ends")
        return bool(goal.is_cancel_requested)

    def _refuse(self, goal: Any, reason: str) -> Any:
        self.get_logger().error(f"scan refused: {reason}")
        with unless_shut_down(self):
            goal.abort()
        return Scan.Result(success=False, message=reason, verdict="failed")

    def _feedback(self, goal: Any, request: ScanRequest) -> Callable[[str], None]:
        sent_s = -math.inf
        sent_phase = ""
        progress = SweepProgress(request)

        def send(phase: str) -> None:
            nonlocal sent_s, sent_phase
            now_s = time.monotonic()
            if phase == sent_phase and now_s - sent_s < _FEEDBACK_S:
                return
            sent_s, sent_phase = now_s, phase
            monitor = self._client.monitor
            reconstructed_mm = monitor.reconstructed_mm()
            share = progress.share(phase, reconstructed_mm)
            feedback = Scan.Feedback(phase=phase, progress=share)
            feedback.position = m_from_mm(monitor.position_mm)
            feedback.waits_for = self._client.waits_for
            state = monitor.reconstruction
            if state is not None:
                feedback.points, feedback.profiles = progress.counts(
                    reconstructed_mm, state.points, state.profiles
                )
                feedback.events_per_second = state.events_per_second
            with unless_shut_down(self):
                goal.publish_feedback(feedback)

        return send

    def _result(self, request: ScanRequest, outcome: ScanOutcome) -> Any:
        summary = outcome.summary
        note = summary.message if summary.verdict == "complete" else summary.line
        if outcome.message and not summary.points:
            # The message already says why there are no points.
            note = ""
        result = Scan.Result(
            success=outcome.end is End.SUCCEEDED,
            message="; ".join(text for text in (outcome.message, note) if text),
            scan_id=request.scan_id,
            profiles=summary.profiles,
            points=summary.points,
            events=summary.events,
            packets_lost=summary.packets_lost,
            events_dropped=summary.events_dropped,
            sigma_median=summary.sigma_median_m,
            verdict=summary.verdict,
            completeness=summary.completeness,
            recording=summary.recording,
        )
        samples = list(self._client.monitor.samples)
        self._client.monitor.restart_samples(math.inf)
        if samples:
            start_ns = crossing_ns(samples, request.start_mm)
            stop_ns = crossing_ns(samples[::-1], request.last_mm)
            result.sweep_start = stamp_from_ns(start_ns if start_ns is not None else samples[0][0])
            result.sweep_stop = stamp_from_ns(stop_ns if stop_ns is not None else samples[-1][0])
        return result

    def _auto_scan(self) -> None:
        missing = self._client.missing()
        if missing or not self._self_client.server_is_ready():
            self._wait_for(missing or "scanner: no scan")
            return
        self.waiting = ""
        self._auto_timer.cancel()
        names = ("start", "stop", "speed", "frequency", "duty", "passes")
        values = {name: self.parameters[name] for name in names}
        self._self_client.send_goal_async(Scan.Goal(**values)).add_done_callback(self._on_own_goal)

    def _on_own_goal(self, answered: Any) -> None:
        self._own_goal = bytes(answered.result().goal_id.uuid)

    def _wait_for(self, missing: str) -> None:
        waiting = f"waiting: {missing}; the scan begins when it is there"
        if waiting == self.waiting or time.monotonic() - self._begun_s < _STARTING_S:
            return
        self.waiting = waiting
        self.get_logger().warning(waiting)

    def _report(self) -> diagnostics.Report:
        scanning = not self._idle.is_set()
        values = {"scans": self._scans, "scanning": scanning, "last": self._last}
        failed = not scanning and End.ABORTED.value in self._last
        if scanning and (lacking := self._client.waits_for):
            return diagnostics.WARN, f"the scan waits: {lacking}", values
        level = diagnostics.WARN if failed else diagnostics.OK
        return level, "scanning" if scanning else self._last, values


def main() -> int:
    """Run the node."""
    return run(ScannerNode, threads=6)


if __name__ == "__main__":
    sys.exit(main())
