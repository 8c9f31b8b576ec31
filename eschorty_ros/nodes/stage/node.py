"""Stage node: moves as an action, odometry, and the stage's pulses."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from std_msgs.msg import Header

from eschorty_ros.action import MoveStage
from eschorty_ros.control.scan_sequence import SPEED_MIN_MM_S
from eschorty_ros.control.stage_states import REST_NS, states_since
from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.core.clocks import PulseTrain
from eschorty_ros.emulation.bench.folder import stage_port
from eschorty_ros.hardware.base.protocols import LinearStage, StageState
from eschorty_ros.msg import PositionTrigger, StageLimits
from eschorty_ros.nodes.ros import diagnostics, drivers, qos
from eschorty_ros.nodes.ros.conversions import m_from_mm, mm_from_m, odometry, stamp_from_ns
from eschorty_ros.nodes.ros.frames import FRAME_PREFIX, frames
from eschorty_ros.nodes.ros.heartbeat import Heartbeat
from eschorty_ros.nodes.ros.lifecycle import DeviceNode
from eschorty_ros.nodes.ros.parameters import Param
from eschorty_ros.nodes.ros.spin import ends, run, unless_shut_down
from eschorty_ros.nodes.stage.parameters import DRIVER_TABLE, make_stage

_FEEDBACK_PERIOD_S = 0.05
_POLL_S = 0.01
# Longer than the 3 s between two heartbeats of DDS, so that lost messages can be repeated.
_ODOM_DEPTH = 2000
_INTERRUPTED = "move interrupted by shutdown"

TABLE = (
    *drivers.table("stage"),
    *DRIVER_TABLE,
    Param("odom_rate", 100.0, "rate of stage/odom in motion; 5 Hz at rest", "Hz", 1.0, 500.0),
    Param("position_sigma", 1e-6, "standard deviation of the position", "m", 0.0, 1.0),
    Param("velocity_sigma", 1e-3, "standard deviation of the velocity", "m/s", 0.0, 10.0),
    Param("home_timeout", 60.0, "longest time for homing", "s", 1.0, 600.0),
    FRAME_PREFIX,
)


class StageNode(DeviceNode):
    """Action ``stage/move``; topics ``stage/odom``, ``stage/limits`` and ``stage/trigger``.

    Activate homes when needed. A goal that cannot be carried out (outside travel, too fast, not
    active, another motion under way) is accepted and aborted at once, because a rejection carries
    no text: the result's ``message`` is the reason. Spin it with several threads: a goal waits in
    its callback.
    """

    def __init__(self, **kwargs: Any) -> None:
        # First, because a node whose constructor fails is destroyed, too.
        self._move: Any = None
        self._lock = threading.RLock()
        self._busy = threading.Lock()
        self._stage: LinearStage | None = None
        self._stops = 0
        super().__init__("stage", TABLE, **kwargs)
        self._frames = frames(self.parameters["frame_prefix"])
        self.moves = 0
        self._command_errors = 0.0
        self._published_ns, self._rested = 0, False
        self._odom = self.create_publisher(Odometry, "stage/odom", qos.stream(_ODOM_DEPTH))
        self._limits = self.create_publisher(StageLimits, "stage/limits", qos.latched())
        self._trigger = self.create_publisher(PositionTrigger, "stage/trigger", qos.latched())
        self._move = ActionServer(
            self,
            MoveStage,
            "stage/move",
            self._on_move,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self._begun = threading.Event()
        threading.Thread(target=self._stream_odom, name="odometry", daemon=True).start()
        diagnostics.Diagnostics(self, self._report, MutuallyExclusiveCallbackGroup())
        Heartbeat(self, "stage/heartbeat", self._healthy)

    def open_device(self) -> None:
        """Open the stage."""
        stage = drivers.make(
            make_stage,
            lambda bench: {"port": stage_port(bench)},
            self.parameters,
            self.now_ns,
        )
        with self._lock:
            self._stage = stage
        self._limits.publish(self._limits_message(stage))
        # Homing gives none.
        self._trigger.publish(self._trigger_message(None))
        self.get_logger().info(f"{stage.identity.model} {stage.identity.serial}")

    def start_device(self) -> None:
        """Home unless homed, and wait for it."""
        stage = self._opened()
        if not stage.state().homed:
            self._home(stage)
        self._trigger.publish(self._trigger_message(stage.trigger))

    def _home(self, stage: LinearStage) -> None:
        stage.home()
        limit_s = self.parameters["home_timeout"]
        end_s = time.monotonic() + limit_s
        while not stage.state().homed:
            if time.monotonic() > end_s:
                raise DeviceError(f"the stage is not homed after {limit_s:g} s; check it")
            if ends(self):
                raise DeviceError("homing interrupted by shutdown")
            time.sleep(_POLL_S)

    def stop_device(self) -> None:
        """Begin a profiled stop."""
        with self._lock:
            self._stops += 1
            if self._stage is not None:
                self._stage.stop()

    def close_device(self) -> None:
        """Release the stage."""
        with self._lock:
            stage, self._stage = self._stage, None
        if stage is not None:
            stage.close()

    def destroy_node(self) -> None:
        """Destroy the action server first, which the node does not list."""
        # rclpy 9.1 drops the future of an answered result request twice and raises.
        with contextlib.suppress(ValueError):
            if self._move is not None:
                self._move.destroy()
        super().destroy_node()

    def _healthy(self) -> bool:
        """Return whether the stage can be moved: without it the laser stays off."""
        stage = self._stage
        return stage is not None and stage.healthy and self.active and not self.failure

    def _opened(self) -> LinearStage:
        stage = self._stage
        if stage is None:
            raise DeviceError(f"stage refused: node is {self.state_label}; configure it first")
        return stage

    def _on_move(self, goal: Any) -> MoveStage.Result:
        if not self._busy.acquire(blocking=False):
            return self._aborted(goal, "stage refused: another move is under way; cancel it first")
        try:
            return self._move_to_goal(goal)
        except EschortyError as error:
            # On its way out the device is closed under the move, whose own error says less.
            return self._aborted(goal, _INTERRUPTED if ends(self) else str(error))
        finally:
            self._busy.release()

    def _move_to_goal(self, goal: Any) -> MoveStage.Result:
        target_mm, speed_mm_s = mm_from_m(goal.request.position), mm_from_m(goal.request.speed)
        self._begin(target_mm, speed_mm_s)
        try:
            state = self._follow(goal)
        except BaseException:
            self.stop_device()
            raise
        if goal.is_cancel_requested:
            with unless_shut_down(self):
                goal.canceled()
            return self._result(False, "canceled: stopped", state)
        if abs(state.position_mm - target_mm) > 1e-3:
            raise DeviceError(
                f"stopped at {state.position_mm:.3f} mm on the way to {target_mm:.3f} mm"
            )
        with unless_shut_down(self):
            goal.succeed()
        return self._result(True, "arrived", state)

    def _begin(self, target_mm: float, speed_mm_s: float) -> None:
        stage, stops = self._opened(), self._stops
        if not self.active:
            raise DeviceError(f"stage refused: node is {self.state_label}; activate it first")
        low_mm, high_mm = stage.travel_mm
        if not low_mm <= target_mm <= high_mm:
            raise DeviceError(
                f"stage refused: position {m_from_mm(target_mm):g} m is outside the travel; "
                f"choose {m_from_mm(low_mm):g} to {m_from_mm(high_mm):g} m"
            )
        if not SPEED_MIN_MM_S <= speed_mm_s <= stage.speed_max_mm_s:
            raise DeviceError(
                f"stage refused: speed {m_from_mm(speed_mm_s):g} m/s; choose "
                f"{m_from_mm(SPEED_MIN_MM_S):g} to {m_from_mm(stage.speed_max_mm_s):g} m/s"
            )
        stage.move_to(target_mm, speed_mm_s)
        if stops != self._stops:
            # The node was deactivated since, perhaps before the stage took the order.
            stage.stop()
        self.moves += 1
        self._begun.set()

    def _follow(self, goal: Any) -> StageState:
        """Wait until the stage rests; return its state."""
        feedback_s = 0.0
        stopping = False
        while True:
            stage = self._opened()
            state = stage.state()
            if not state.moving:
                return state
            if goal.is_cancel_requested and not stopping:
                stage.stop()
                stopping = True
            if ends(self):
                raise DeviceError(_INTERRUPTED)
            if time.monotonic() - feedback_s >= _FEEDBACK_PERIOD_S:
                feedback_s = time.monotonic()
                feedback = MoveStage.Feedback(
                    position=m_from_mm(state.position_mm),
                    velocity=m_from_mm(state.velocity_mm_s),
                )
                with unless_shut_down(self):
                    goal.publish_feedback(feedback)
            time.sleep(_POLL_S)

    def _aborted(self, goal: Any, reason: str) -> MoveStage.Result:
        if not ends(self):
            self.get_logger().warning(reason)
        with unless_shut_down(self):
            goal.abort()
        stage, state = self._stage, None
        with contextlib.suppress(EschortyError):
            state = stage.state() if stage is not None else None
        return self._result(False, reason, state)

    @staticmethod
    def _result(success: bool, message: str, state: StageState | None) -> MoveStage.Result:
        position_m = m_from_mm(state.position_mm) if state is not None else float("nan")
        return MoveStage.Result(success=success, message=message, position=position_m)

    def _stream_odom(self) -> None:
        """Publish the odometry until the node ends; a timer of rclpy costs much more."""
        while not ends(self):
            try:
                self._publish_odom()
            except EschortyError as error:
                self.fault(f"stage lost: {error}")
            except Exception as error:
                # A signal ends the context while this thread may be publishing.
                if not ends(self):
                    self.fault(f"odometry failed: {error!r}")
            if self._rested:
                self._begun.wait(REST_NS * 1e-9)
                self._begun.clear()
            else:
                time.sleep(1.0 / self.parameters["odom_rate"])

    def _publish_odom(self) -> None:
        stage = self._stage
        if stage is None:
            return
        period_ns = round(1e9 / self.parameters["odom_rate"])
        for state in states_since(stage, self._published_ns, period_ns, self._rested):
            self._published_ns, self._rested = state.t_ns, not state.moving
            self._odom.publish(self._odometry(state))

    def _header(self) -> Header:
        return Header(frame_id=self._frames.base, stamp=stamp_from_ns(self.now_ns()))

    def _limits_message(self, stage: LinearStage) -> StageLimits:
        low, high = (m_from_mm(end_mm) for end_mm in stage.travel_mm)
        return StageLimits(
            header=self._header(),
            travel_low=low,
            travel_high=high,
            speed_max=m_from_mm(stage.speed_max_mm_s),
            acceleration=m_from_mm(stage.acceleration_mm_s2),
        )

    def _trigger_message(self, pulses: PulseTrain | None) -> PositionTrigger:
        message = PositionTrigger(header=self._header())
        if pulses is not None:
            message.first = m_from_mm(pulses.first_mm)
            message.interval = m_from_mm(pulses.interval_mm)
            message.count = pulses.count
        return message

    def _odometry(self, state: StageState) -> Odometry:
        message = odometry(self._frames, state.t_ns, state.position_mm)
        message.twist.twist.linear.y = m_from_mm(state.velocity_mm_s)
        message.pose.covariance[7] = self.parameters["position_sigma"] ** 2
        message.twist.covariance[7] = self.parameters["velocity_sigma"] ** 2
        return message

    def _report(self) -> diagnostics.Report:
        stage = self._stage
        if stage is None or self.failure:
            level = diagnostics.ERROR if self.failure else diagnostics.OK
            return level, self.failure or self.state_label, {"state": self.state_label}
        try:
            state = stage.state()
        except EschortyError as error:
            return diagnostics.ERROR, str(error), {"state": self.state_label}
        statistics = stage.statistics()
        known, self._command_errors = self._command_errors, statistics.get("command_errors", 0.0)
        values = {
            "device": stage.identity.model,
            "state": self.state_label,
            "position_m": m_from_mm(state.position_mm),
            "velocity_m_s": m_from_mm(state.velocity_mm_s),
            "homed": state.homed,
            "moving": state.moving,
            "flags": " ".join(state.flags),
            "moves": self.moves,
            **statistics,
        }
        if self.active and not state.homed:
            return diagnostics.WARN, "not homed", values
        if self._command_errors > known:
            return diagnostics.WARN, "the stage controller refused a command", values
        return diagnostics.OK, "moving" if state.moving else "at rest", values


def main() -> None:
    """Entry point of the stage node."""
    sys.exit(run(StageNode, threads=4))


if __name__ == "__main__":
    main()
