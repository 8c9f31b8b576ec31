"""Hands on laser and stage for whoever sequences them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from action_msgs.msg import GoalStatus
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.action import MoveStage
from eschorty_ros.msg import LaserState
from eschorty_ros.nodes.conversions import m_from_mm
from eschorty_ros.nodes.heartbeat import Heartbeat
from eschorty_ros.nodes.laser_gate import LEASE
from eschorty_ros.nodes.paced_client import PacedClient
from eschorty_ros.nodes.scan_sequence import ScanFailure

# A sequence that has not come by for so long hangs.
_TICK_LIMIT_S = 1.0
# In refusals for want of a sign of life.
_BEAT = "/heartbeat"


class LaserStageRig(PacedClient):
    """Laser and stage over the other nodes' topics, services and action.

    Parameters
    ----------
    node : rclpy.node.Node
    node_timeout_s, service_timeout_s, events_timeout_s : float
        Longest wait for the nodes to appear, for an answer, and for the events to go on.
    services : mapping of str to service type
        What else is needed, by name.
    """

    def __init__(
        self,
        node: Node,
        node_timeout_s: float,
        service_timeout_s: float,
        events_timeout_s: float,
        services: Mapping[str, Any] | None = None,
    ) -> None:
        needed = {
            "laser/set_parameters": SetParameters,
            "laser/arm": Trigger,
            "laser/enable": SetBool,
            **(services or {}),
        }
        super().__init__(node, needed, service_timeout_s, events_timeout_s)
        self._node_timeout_s = node_timeout_s
        self._beating = False
        self._heartbeat = Heartbeat(node, LEASE, self._wants_light)
        self._stage = ActionClient(node, MoveStage, "stage/move", callback_group=self._group)
        self._sent: Any = None

    def check_nodes(self) -> None:
        """See ``Hands``."""
        begun_ns = self.monitor.until_ns
        for there, failure in self._needed(begun_ns):
            self._wait(there, self._node_timeout_s, failure)

    def missing(self) -> str:
        """Name what is not there yet, one thing of each node; empty when a sequence can begin."""
        absent = [failure for there, failure in self._needed(0) if not there()]
        named = {text.split(":")[0]: text for text in reversed(absent) if isinstance(text, str)}
        if absent and not named:
            # Whatever is missing keeps events from being reconstructed, so it comes first.
            return self.monitor.why_no_progress()
        return "; ".join(reversed(named.values()))

    def _needed(self, begun_ns: int) -> list[tuple[Callable[[], bool], str | Callable[[], str]]]:
        """List what a sequence needs, in order, each with what to say without it."""
        servers = (
            *((name, client.service_is_ready) for name, client in self._clients.items()),
            ("stage/move", self._stage.server_is_ready),
        )
        return [
            *((there, f"{what.split('/')[0]}: no {what}") for what, there in servers),
            (lambda: self.monitor.stage_heard, "stage: no odometry"),
            (lambda: self.monitor.at_rest, "stage: another move does not end"),
            (lambda: self.monitor.laser is not None, "laser: no state"),
            (lambda: self.monitor.until_ns > begun_ns, self.monitor.why_no_progress),
        ]

    def configure_laser(self, frequency_hz: float, duty: float) -> None:
        """See ``Hands``."""
        values = {"frequency": float(frequency_hz), "duty": float(duty)}
        wanted = {name: value for name, value in values.items() if value}
        if not wanted:
            return
        messages = [Parameter(name, value=value).to_parameter_msg()
                    for name, value in wanted.items()]  # fmt: skip
        answer = self._call("laser/set_parameters", SetParameters.Request(parameters=messages))
        for result in answer.results:
            if not result.successful:
                raise ScanFailure(f"laser: {result.reason}")

        def applied() -> bool:
            state = self.monitor.laser
            return state is not None and all(
                abs(getattr(state, name) - value) <= 1e-3 * value for name, value in wanted.items()
            )

        self._wait(applied, self._service_timeout_s,
                   f"laser: its state does not show {wanted}")  # fmt: skip

    def move(self, position_mm: float, speed_mm_s: float) -> None:
        """See ``Hands``."""
        self.monitor.samples.clear()
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
        while not future.done():
            self._pause()
            self.monitor.check_stage()
        self._sent = None
        answer = future.result()
        if answer.status != GoalStatus.STATUS_SUCCEEDED or not answer.result.success:
            raise ScanFailure(f"stage: {answer.result.message or 'the move did not succeed'}")

    def stop_stage(self) -> None:
        """See ``Hands``."""
        sent, self._sent = self._sent, None
        if sent is None:
            return
        handle = self._answer(sent, "stage/move")
        if not handle.accepted:
            return
        with self._living_context():
            ended = handle.cancel_goal_async(), handle.get_result_async()
        for future in ended:
            self._answer(future, "stage/move")

    def laser_on(self) -> None:
        """See ``Hands``."""
        self._pause()
        self._beating = True
        self._wait(lambda: self._heartbeat.beating, self._service_timeout_s,
                   "laser: no heartbeat of its own")  # fmt: skip
        ends_s = time.monotonic() + self._service_timeout_s
        while refusal := self._light():
            # Camera and stage that have only just come up beat soon.
            if _BEAT not in refusal or time.monotonic() > ends_s:
                raise ScanFailure(f"laser: {refusal}")
            self._pause()
        self._wait(lambda: self.monitor.output == LaserState.OUTPUT_ON, self._service_timeout_s,
                   "laser: its output does not read back on")  # fmt: skip

    def _light(self) -> str:
        """Arm and enable; why not, ``""`` when it was done."""
        for name, request in (
            ("laser/arm", Trigger.Request()),
            ("laser/enable", SetBool.Request(data=True)),
        ):
            answer = self._call(name, request)
            if not answer.success:
                return str(answer.message)
        return ""

    def laser_off(self) -> None:
        """See ``Hands``."""
        try:
            if self._beating:
                answer = self._call("laser/enable", SetBool.Request(data=False))
                if not answer.success:
                    raise ScanFailure(f"laser: {answer.message}")
                self._wait(lambda: self.monitor.output == LaserState.OUTPUT_OFF,
                           self._service_timeout_s,
                           "laser: its output does not read back off")  # fmt: skip
        finally:
            # Without it the laser switches itself off, should the call have failed.
            self._beating = False

    def _wants_light(self) -> bool:
        return self._beating and time.monotonic() - self._tick_s < _TICK_LIMIT_S
