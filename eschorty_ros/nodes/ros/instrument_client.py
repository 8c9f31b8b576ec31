"""Laser, stage and reconstruction as a sequence uses them: over topics, services and an action."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, ClassVar

from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import TransitionEvent
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.action import MoveStage
from eschorty_ros.control.instrument_monitor import (
    InstrumentMonitor,
    LaserReport,
    ReconstructionStatus,
)
from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT
from eschorty_ros.control.paced_waiting import PacedWaiting
from eschorty_ros.control.scan_sequence import (
    End,
    MoveLimits,
    ScanFailure,
    ScanRequest,
    ScanSummary,
)
from eschorty_ros.core.base.errors import one_line
from eschorty_ros.core.base.numbers import number, positive
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.msg import LaserState, ReconstructionState, StageLimits
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.border import check_text
from eschorty_ros.nodes.ros.conversions import m_from_mm, mm_from_m, stage_position_mm
from eschorty_ros.nodes.ros.diagnostics import NO_CLOCK
from eschorty_ros.nodes.ros.executor import ShortGroup
from eschorty_ros.nodes.ros.heartbeat import Heartbeat
from eschorty_ros.nodes.ros.peers import OnePublisher, age_s
from eschorty_ros.nodes.ros.repeated_call import RepeatedCall
from eschorty_ros.srv import BeginScan, EndScan

# The heartbeat stops when the sequence has not ticked for this long.
_TICK_LIMIT_S = 1.0
# Part of the laser's reason when a heartbeat is missing.
_HEARTBEAT = "/heartbeat"
# DDS drops a node that has been killed within 20 s.
_DEAD_S = 25.0
_NOT_ACTIVE = "its node is not active; its log has the reason: mend it, configure and activate it"
_STARTING = (
    "its node is there; a first start compiles kernels, for some minutes: wait, or run "
    "`eschorty compile` before"
)
# Longer than until the reconstruction gives up, with the longest stage_timeout.
_ASSEMBLE_S = 100.0
# The reconstruction first works off the packets that a broken link has held back.
_BEGIN_S = 20.0
# For an answer of a node that no longer reports.
_LATE_NODE_WAIT_S = 0.3
_LEAST_WAIT_S = 0.1
_CLOCKS_S = 20.0
_ENABLE_RETRY_S = 0.25


class InstrumentClient(PacedWaiting):
    """Laser and stage over the other nodes' topics, services and action.

    - ``node_timeout_s``, ``service_timeout_s``, ``events_timeout_s``: Longest wait for the nodes to
      appear, for an answer, and for the events to continue.
    """

    SERVICES: ClassVar[Mapping[str, Any]] = {
        "laser/set_parameters": SetParameters,
        "laser/arm": Trigger,
        "laser/enable": SetBool,
    }

    def __init__(
        self,
        node: Node,
        node_timeout_s: float,
        service_timeout_s: float,
        events_timeout_s: float,
    ) -> None:
        self._node = node
        topic = node.resolve_topic_name("camera/events")
        super().__init__(
            node.get_name(),
            InstrumentMonitor(lambda: node.count_publishers(topic) > 0),
            lambda: int(node.get_clock().now().nanoseconds),
            node.context.ok,
            events_timeout_s,
        )
        self._subscribed = False
        group = ReentrantCallbackGroup()
        self._clients = {
            name: node.create_client(kind, name, callback_group=group)
            for name, kind in self.SERVICES.items()
        }
        self._states = {
            name: _LifecycleState(
                node.create_client(GetState, f"{name}/get_state", callback_group=group)
            )
            for name in ("laser", "stage")
        }
        self._stage = ActionClient(node, MoveStage, "stage/move", callback_group=group)
        self._node_timeout_s = node_timeout_s
        self._service_timeout_s = service_timeout_s
        self._modulation = 0.0, 0.0
        self._heartbeat_on = False
        self._heartbeat = Heartbeat(
            node, CLIENT_HEARTBEAT, self._light_requested, lambda: self._heartbeat_on
        )
        self._sent: Any = None

    def subscribe(self) -> None:
        """Receive the other nodes' state from now on; the first sequence does it, too."""
        if not self._subscribed:
            self._subscribed = True
            _subscribe(self._node, self.monitor)

    def prepare(self, canceled: Callable[[], bool], feedback: Callable[[str], None]) -> None:
        """Reset for a new sequence; both callables are used at every tick."""
        self.subscribe()

        def guarded(phase: str) -> None:
            with self._shutdown_as_failure():
                feedback(phase)

        super().prepare(canceled, guarded)

    def check_nodes(self) -> None:
        """Raise ``ScanFailure`` that names the component that does not answer."""
        begun_ns = self.monitor.until_ns
        for state in self._states.values():
            state.forget()
        end_s = time.monotonic() + self._node_timeout_s
        for holds, failure in self._needed(begun_ns):
            self.wait(holds, max(end_s - time.monotonic(), _LEAST_WAIT_S), failure)
        self._check_clocks()

    def _check_clocks(self) -> None:
        """Compare the nodes' clocks; a busy computer gets some seconds for prompt messages."""
        end_s = time.monotonic() + _CLOCKS_S
        while True:
            try:
                self.monitor.check_clocks()
            except ScanFailure as failure:
                if time.monotonic() > end_s:
                    raise
                self.waits_for = str(failure)
                self.tick()
            else:
                self.waits_for = ""
                return

    def missing(self) -> str:
        """Return the missing conditions, one of each node; ``""`` when a sequence can begin."""
        absent = [failure for holds, failure in self._needed(0) if not holds()]
        texts = [text if isinstance(text, str) else text() for text in absent]
        named = {text.split(":")[0]: text for text in reversed(texts)}
        return "; ".join(reversed(named.values()))

    def _needed(self, begun_ns: int) -> list[tuple[Callable[[], bool], str | Callable[[], str]]]:
        """Return the conditions of a sequence in order, each with the failure without it."""
        servers = (
            *((name, client.service_is_ready) for name, client in self._clients.items()),
            ("stage/move", self._stage.server_is_ready),
        )
        states = self._states.items()
        return [
            (lambda: self._now_ns() > 0, f"{self._node.get_name()}: {NO_CLOCK}"),
            *((ready, partial(self._absent, name)) for name, ready in servers),
            *((state.active, f"{name}: {_NOT_ACTIVE}") for name, state in states),
            (lambda: self.monitor.stage_reports, "stage: no odometry"),
            (lambda: self.monitor.at_rest, "stage: another move does not end"),
            (lambda: self.monitor.laser_reports, "laser: no state"),
            (lambda: self.monitor.until_ns > begun_ns, self.monitor.cause_of_no_progress),
        ]

    def _absent(self, name: str) -> str:
        """Return the failure without a service or an action; a node offers it when it has begun."""
        component, nodes = name.split("/")[0], self._node.get_node_names_and_namespaces()
        own = (component, self._node.get_namespace())
        starts = component == "reconstruction" and own in nodes
        return f"{component}: no {name}" + (f"; {_STARTING}" if starts else "")

    def stage_limits(self) -> MoveLimits:
        """Return the limits that the stage publishes; raise ``ScanFailure`` without any."""
        self.wait(lambda: self.monitor.limits is not None, self._service_timeout_s,
                  "stage: no limits on stage/limits")  # fmt: skip
        assert self.monitor.limits is not None
        return self.monitor.limits

    def configure_laser(self, frequency_hz: float, duty: float) -> None:
        """Set the values that are not 0; raise ``ScanFailure`` with the laser's reason."""
        self._modulation = frequency_hz, duty
        messages = [Parameter(name, value=float(value)).to_parameter_msg()
                    for name, value in (("frequency", frequency_hz), ("duty", duty))
                    if value]  # fmt: skip
        if not messages:
            return
        answer = self._call("laser/set_parameters", SetParameters.Request(parameters=messages))
        for result in answer.results:
            if not result.successful:
                raise ScanFailure(f"laser: {result.reason}")
        self.wait(lambda: not self._other_modulation(), self._service_timeout_s,
                  self._other_modulation)  # fmt: skip

    def _other_modulation(self) -> str:
        return self.monitor.other_modulation(*self._modulation)

    def move(self, position_mm: float, speed_mm_s: float) -> None:
        """Move the stage and wait for the end of the motion."""
        goal = MoveStage.Goal(position=m_from_mm(position_mm), speed=m_from_mm(speed_mm_s))
        # Kept before waiting: a cancel while the answer is on its way must still stop the stage.
        self._sent = self._stage.send_goal_async(goal)
        handle = self._answer(self._sent, "stage/move")
        if not handle.accepted:
            self._sent = None
            raise ScanFailure(
                f"stage: refused to move to {position_mm * 1e-3:g} m at {speed_mm_s * 1e-3:g} m/s"
            )
        future = handle.get_result_async()
        begun_s = time.monotonic()
        while not future.done():
            self.tick()
            self.check(self.monitor.check_stage, lambda: self.monitor.check_motion(begun_s))
        self._sent = None
        answer = future.result()
        if answer.status != GoalStatus.STATUS_SUCCEEDED or not answer.result.success:
            reason = answer.result.message.removeprefix("stage ") or "the move did not succeed"
            raise ScanFailure(f"stage: {reason}")

    def stop_stage(self) -> None:
        """End a move under way and wait until the stage rests."""
        sent, self._sent = self._sent, None
        if sent is None:
            return
        handle = self._answer(sent, "stage/move")
        if not handle.accepted:
            return
        with self._shutdown_as_failure():
            ended = handle.cancel_goal_async(), handle.get_result_async()
        for future in ended:
            self._answer(future, "stage/move")

    def laser_on(self) -> None:
        """Start the heartbeat, arm, enable; return when the output reads back on, as it was set."""
        self.tick()
        self._heartbeat_on = True
        self._heartbeat.begin()
        self.wait(lambda: self._heartbeat.healthy, self._service_timeout_s,
                  "laser: no heartbeat of its own")  # fmt: skip
        ends_s = time.monotonic() + self._service_timeout_s
        while refusal := self._arm_and_enable():
            # The heartbeats of a camera and a stage that have just started come soon.
            if _HEARTBEAT not in refusal or time.monotonic() > ends_s:
                raise ScanFailure(refusal)
            self.waits_for = refusal
            retry_s = time.monotonic() + _ENABLE_RETRY_S
            while time.monotonic() < retry_s:
                self.tick()
        self.wait(lambda: self.monitor.output == LaserOutput.ON, self._service_timeout_s,
                  "laser: its output does not read back on")  # fmt: skip
        self._check_modulation()

    def _check_modulation(self) -> None:
        """Raise ``ScanFailure`` when the modulation read back is no longer the sequence's."""
        if fault := self._other_modulation():
            raise ScanFailure(f"{fault}; another program has set it: stop that program")

    def _arm_and_enable(self) -> str:
        """Return the laser's reason when it refuses, ``""`` when it does not."""
        for name, request in (
            ("laser/arm", Trigger.Request()),
            ("laser/enable", SetBool.Request(data=True)),
        ):
            self._check_modulation()
            answer = self._call(name, request)
            if not answer.success:
                return str(answer.message)
        return ""

    def laser_off(self) -> None:
        """Disable; return when the output reads back off. The heartbeat ends in any case."""
        try:
            if self._heartbeat_on:
                answer = self._call("laser/enable", SetBool.Request(data=False))
                if not answer.success:
                    raise ScanFailure(str(answer.message))
                self.wait(lambda: self.monitor.output == LaserOutput.OFF,
                          self._service_timeout_s,
                          "laser: its output does not read back off")  # fmt: skip
        finally:
            # Without it the laser switches itself off, also when the call has failed.
            self._heartbeat_on = False

    def _light_requested(self) -> bool:
        return self._heartbeat_on and self.ticked_within(_TICK_LIMIT_S)

    def _answer(self, future: Any, name: str) -> Any:
        self._await(future.done, name, self._service_timeout_s)
        return future.result()

    def _await(
        self, answered: Callable[[], bool], name: str, timeout_s: float, failure: str = ""
    ) -> None:
        """Wait for an answer; only shortly for one of a node that no longer reports."""
        component = name.split("/")[0]
        if self.monitor.report_late(component):
            timeout_s = _LATE_NODE_WAIT_S
        self.wait(answered, timeout_s, failure or f"{component}: no answer of {name}")

    def _call(
        self,
        name: str,
        request: Any,
        timeout_s: float | None = None,
        repeat: bool = True,
        failure: str = "",
    ) -> Any:
        """Return a service's answer; with ``repeat`` a request without one is sent again.

        ``failure`` is named in place of the lack of an answer.
        """
        call = RepeatedCall(self._clients[name], request, again=repeat)

        def answered() -> bool:
            if name.startswith("reconstruction/"):
                self.monitor.check_reconstruction()
            with self._shutdown_as_failure():
                return call.done()

        self._await(answered, name, timeout_s or self._service_timeout_s, failure)
        return call.result()

    @contextlib.contextmanager
    def _shutdown_as_failure(self) -> Iterator[None]:
        """Turn the errors of a context that a signal has ended into a ``ScanFailure``."""
        try:
            yield
        except (_rclpy.RCLError, _rclpy.InvalidHandle) as error:
            raise ScanFailure(
                f"{self._node.get_name()}: the node was shut down: {error}"
            ) from error


class ScanClient(InstrumentClient):
    """Instrument client with the reconstruction's services; arguments as its base's."""

    SERVICES: ClassVar[Mapping[str, Any]] = {
        **InstrumentClient.SERVICES,
        "reconstruction/begin_scan": BeginScan,
        "reconstruction/end_scan": EndScan,
    }

    def begin_scan(self, request: ScanRequest) -> str:
        """Start to collect points; return the recording's folder, ``""`` without one.

        A scan that is still open is ended and published first.
        """
        state = self.monitor.reconstruction
        if state is not None and state.scan_id:
            self._node.get_logger().warning(f"ending {state.scan_id}, which was left open")
            # The reconstruction may end it meanwhile; what else fails, fails again.
            with contextlib.suppress(ScanFailure):
                self.end_scan(state.scan_id, "it was left open")
        begin = BeginScan.Request(
            scan_id=request.scan_id,
            start=m_from_mm(request.start_mm),
            stop=m_from_mm(request.stop_mm),
            passes=request.passes,
            speed=m_from_mm(request.speed_mm_s),
        )
        self.monitor.restart_samples(self._now_ns())
        ends_s, refusal = time.monotonic() + _DEAD_S, ""
        while not (answer := self._begun(begin, refusal)).success:
            refusal = f"reconstruction: {answer.message}"
            if not answer.retry or time.monotonic() > ends_s:
                raise ScanFailure(refusal)
            self.tick()
        return str(answer.recording)

    def _begun(self, begin: Any, refusal: str) -> Any:
        """Return the answer; a cancel before it would leave a scan that is never ended.

        ``refusal`` is the one before, which the feedback names meanwhile.
        """
        with self.shielded():
            return self._call("reconstruction/begin_scan", begin, _BEGIN_S, failure=refusal)

    def end_scan(self, scan_id: str, reason: str) -> ScanSummary:
        """Publish the points collected; ``reason`` is why the scan ends early, ``""`` otherwise."""
        request = EndScan.Request(scan_id=scan_id, reason=reason)
        answer = self._call("reconstruction/end_scan", request, _ASSEMBLE_S, repeat=False)
        if not answer.success:
            raise ScanFailure(f"reconstruction: {answer.message}")
        return ScanSummary(answer.profiles, answer.points, answer.events, answer.packets_lost,
                           answer.events_dropped, answer.sigma_median, answer.message,
                           answer.completeness, answer.recording)  # fmt: skip


def end_goal(goal: Any, end: End) -> None:
    """End the goal of a sequence as the sequence has ended."""
    if end is End.SUCCEEDED:
        goal.succeed()
    elif end is End.CANCELED and goal.is_cancel_requested:
        goal.canceled()
    else:
        goal.abort()


class _LifecycleState:
    """The state of a lifecycle node, requested repeatedly; one without it counts as active."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._call: RepeatedCall | None = None
        self._active = False

    def forget(self) -> None:
        """Wait for a new answer: the last one may be old."""
        self._call, self._active = None, False

    def active(self) -> bool:
        """Return whether the last answer was ``active``; request the next one."""
        if not self._client.service_is_ready():
            return True
        if self._call is None:
            self._call = RepeatedCall(self._client, GetState.Request(), again=True)
        if self._call.done():
            self._active, self._call = self._call.result().current_state.label == "active", None
        return self._active


def _subscribe(node: Node, monitor: InstrumentMonitor) -> None:
    """Let the other nodes' topics update the monitor."""
    laser, reconstruction, stage, worker = (OnePublisher() for _ in range(4))

    def on_laser(message: LaserState, info: Mapping[str, Any]) -> None:
        laser.check(info)
        monitor.update_laser(
            LaserReport(message.output, message.frequency, message.duty, one_line(message.reason)),
            age_s(node, info, ns_from_stamp(message.header.stamp)),
        )

    def on_laser_node(message: TransitionEvent) -> None:
        monitor.laser_failed = message.start_state.label == "errorprocessing"

    def on_reconstruction(message: ReconstructionState, info: Mapping[str, Any]) -> None:
        reconstruction.check(info)
        monitor.update_reconstruction(
            ReconstructionStatus(
                ns_from_stamp(message.processed_until),
                message.events_per_second,
                message.profiles,
                message.points,
                check_text("scan_id", message.scan_id),
                message.packet_age,
            ),
            age_s(node, info, ns_from_stamp(message.header.stamp)),
        )

    def on_stage(message: Odometry, info: Mapping[str, Any]) -> None:
        stage.check(info)
        speed_m_s = number("twist.twist.linear.y", message.twist.twist.linear.y)
        monitor.update_stage(
            ns_from_stamp(message.header.stamp),
            stage_position_mm(message),
            mm_from_m(speed_m_s),
            age_s(node, info, ns_from_stamp(message.header.stamp)),
        )

    def on_limits(message: StageLimits) -> None:
        low, high = (number(name, getattr(message, name)) for name in ("travel_low", "travel_high"))
        monitor.limits = MoveLimits(
            (mm_from_m(low), mm_from_m(high)),
            mm_from_m(positive("speed_max", message.speed_max)),
            mm_from_m(positive("acceleration", message.acceleration)),
        )

    def on_heartbeat(message: Header, info: Mapping[str, Any]) -> None:
        worker.check(info)
        monitor.update_heartbeat(check_text("frame_id", message.frame_id))

    # One message at a time, so that samples stay in order.
    group = ShortGroup()
    for kind, topic_name, callback, profile in (
        (LaserState, "laser/state", on_laser, qos.latched(qos.STATE_HISTORY)),
        (TransitionEvent, "laser/transition_event", on_laser_node, 10),
        (ReconstructionState, "reconstruction/state", on_reconstruction, 10),
        (Odometry, "stage/odom", on_stage, qos.stream()),
        (StageLimits, "stage/limits", on_limits, qos.latched()),
        (Header, "reconstruction/heartbeat", on_heartbeat, qos.heartbeat()),
    ):
        node.create_subscription(kind, topic_name, callback, profile, callback_group=group)
