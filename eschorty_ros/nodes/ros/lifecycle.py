"""The lifecycle of camera, laser and stage: every failure is logged and leads to a safe state."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from eschorty_ros.core.base.errors import (
    ArgumentError,
    DeviceError,
    DeviceNotReadyError,
    EschortyError,
)
from eschorty_ros.nodes.ros.parameters import Param, Parameters
from eschorty_ros.nodes.ros.steady_timer import steady_timer

AUTO_START = Param("auto_start", True, "configure and activate at start")
RETRY_S = 2.0
# A period of 0 keeps rclpy's EventsExecutor busy.
_SOON_S = 1e-3


class DeviceNode(LifecycleNode):
    """Lifecycle node around one device.

    A subclass fills in ``open_device``, ``start_device``, ``stop_device`` and ``close_device``;
    the last two are idempotent, may run in any state and thread, and leave nothing switched on.
    Configure opens, activate starts, deactivate stops, cleanup stops and closes. A failure in
    configure closes and leaves the node unconfigured; a failure in any other transition, or
    ``fault`` at any time, stops and closes the device and leads through error processing to
    unconfigured. Every failure is logged: one line for an ``EschortyError``.

    With ``auto_start``, a node whose device cannot be opened stays unconfigured, logs the reason
    when it changes, holds it in ``waiting`` and retries every 2 s. After a failure in operation
    nothing restarts by itself: the user has to configure and activate again.

    - ``name``: Node name.
    - ``table``: The node's parameters besides ``auto_start``.
    - ``on_change``: See ``Parameters``.

    Public attributes:
    - ``failure``: The last failure, empty after a successful configure.
    - ``waiting``: The reason for waiting and the time of the next attempt, ``""`` when it does not
      wait.

    Raises ``ArgumentError`` for simulated time, in which a device seems to jump or to stand still.
    """

    def __init__(
        self,
        name: str,
        table: Iterable[Param],
        on_change: Callable[[dict[str, Any]], None] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(name, **kwargs)
        self._check_time(self.get_parameter("use_sim_time").value)
        self.parameters = Parameters(self, (AUTO_START, *table), on_change)
        self.add_on_set_parameters_callback(self._keep_time)
        self.failure = ""
        self.waiting = ""
        self._auto_starting = False
        self._logged = ""
        self._faulted = threading.Event()
        self._fault_leaving = self.on_request(self._leave_after_fault)
        self._start_timer = (
            steady_timer(self, _SOON_S, self._auto_start) if self.parameters["auto_start"] else None
        )

    def open_device(self) -> None:
        """Open the device and apply the settings."""
        raise NotImplementedError

    def start_device(self) -> None:
        """Start the work of the active state."""
        raise NotImplementedError

    def stop_device(self) -> None:
        """Stop the work of the active state."""
        raise NotImplementedError

    def close_device(self) -> None:
        """Release the device."""
        raise NotImplementedError

    @property
    def state_label(self) -> str:
        """Return the lifecycle state, e.g. ``active``."""
        return str(self._state_machine.current_state[1])

    @property
    def active(self) -> bool:
        """Return whether the node is active."""
        return self.state_label == "active"

    def safe_state(self) -> None:
        """Stop and close the device in any state of the node; uses no ROS."""
        try:
            self.stop_device()
        finally:
            self.close_device()

    def fault(self, reason: str) -> None:
        """Log a failure of the device and lead the node to unconfigured; from any thread."""
        known, self.failure = self.failure, reason
        if reason != known:
            self.get_logger().error(reason)
        if not self._faulted.is_set():
            self._faulted.set()
            self._fault_leaving()

    def on_request(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Return what makes the executor call ``callback`` once; from any thread."""

        def once() -> None:
            timer.cancel()
            callback()

        timer = steady_timer(self, _SOON_S, once, autostart=False)
        reset: Callable[[], None] = timer.reset
        return reset

    def now_ns(self) -> int:
        """Return the node's ROS time, int64 nanoseconds."""
        return int(self.get_clock().now().nanoseconds)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the device."""
        self.failure = ""
        if not self._auto_starting:
            self.waiting = ""
        self._faulted.clear()
        opening = self._open_or_wait if self._auto_starting else self.open_device
        if not self._attempt("configure", opening) or self.waiting:
            self._attempt("close", self.safe_state)
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Enable the publishers, then start."""
        result = super().on_activate(state)
        if not self._attempt("activate", self.start_device):
            return TransitionCallbackReturn.ERROR
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop, then disable the publishers."""
        stopped = self._attempt("deactivate", self.stop_device)
        result = super().on_deactivate(state)
        return result if stopped and not self._faulted.is_set() else TransitionCallbackReturn.ERROR

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and close."""
        closed = self._attempt("cleanup", self.safe_state)
        result = super().on_cleanup(state)
        return result if closed else TransitionCallbackReturn.ERROR

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and close."""
        closed = self._attempt("shutdown", self.safe_state)
        result = super().on_shutdown(state)
        return result if closed else TransitionCallbackReturn.ERROR

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and close; unconfigured when that works, finalized when it does not."""
        closed = self._attempt("error", self.safe_state)
        super().on_deactivate(state)
        return TransitionCallbackReturn.SUCCESS if closed else TransitionCallbackReturn.FAILURE

    def _check_time(self, simulated: object) -> None:
        if simulated:
            raise ArgumentError(
                "use_sim_time is true, but devices run in the host's time; "
                f"leave it out for {self.get_name()}"
            )

    def _keep_time(self, proposed: Sequence[Parameter[Any]]) -> SetParametersResult:
        """Refuse simulated time; called before rclpy's own callback, which would switch to it."""
        try:
            for parameter in proposed:
                if parameter.name == "use_sim_time":
                    self._check_time(parameter.value)
        except ArgumentError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _attempt(self, name: str, step: Callable[[], None]) -> bool:
        try:
            step()
        except EschortyError as error:
            self.failure = f"{name}: {error}"
        except Exception:
            self.failure = f"{name}: {traceback.format_exc()}"
        else:
            return True
        self.get_logger().error(self.failure)
        return False

    def _auto_start(self) -> None:
        assert self._start_timer is not None
        configured = TransitionCallbackReturn.FAILURE
        if self.state_label == "unconfigured":
            self._auto_starting = True
            configured = self.trigger_configure()
            self._auto_starting = False
        if self.state_label != "unconfigured" or self.failure:
            self.waiting = ""
        if self.waiting:
            self._start_timer.timer_period_ns = round(RETRY_S * 1e9)
            self._start_timer.reset()
            return
        self._start_timer.cancel()
        if configured == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def _open_or_wait(self) -> None:
        """Open the device; set ``waiting`` when that fails."""
        try:
            self.open_device()
        except DeviceError as error:
            self.waiting = f"waiting: {error}; trying again every {RETRY_S:g} s"
            if self.waiting != self._logged and isinstance(error, DeviceNotReadyError):
                self.get_logger().info(self.waiting)
            elif self.waiting != self._logged:
                self.get_logger().warning(self.waiting)
            self._logged = self.waiting
        else:
            self.waiting = ""

    def _leave_after_fault(self) -> None:
        if not self._faulted.is_set():
            return
        if self.active:
            self.trigger_deactivate()
        elif self.state_label == "inactive":
            self.trigger_cleanup()
