"""Laser node: gates the line through its generator, dark unless every condition for light holds."""

from __future__ import annotations

import contextlib
import sys
import threading
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.core.errors import DeviceError, EschortyError
from eschorty_ros.core.modulation import (
    FREQUENCY_MAX_HZ,
    FREQUENCY_MIN_HZ,
    WAVEFORMS,
    Modulation,
)
from eschorty_ros.hardware.protocols import LaserModulator, LaserOutput
from eschorty_ros.msg import LaserState
from eschorty_ros.nodes import diagnostics, drivers, qos
from eschorty_ros.nodes.conversions import stamp_from_ns
from eschorty_ros.nodes.laser_gate import LaserGate
from eschorty_ros.nodes.lifecycle import DeviceNode
from eschorty_ros.nodes.parameters import Param
from eschorty_ros.nodes.spin import run

STATE_RATE_HZ = 20.0
WATCHDOG_PERIOD_S = 0.02

TABLE = (
    drivers.DRIVER,
    Param(
        "frequency",
        70.0,
        "modulation frequency",
        "Hz",
        FREQUENCY_MIN_HZ,
        FREQUENCY_MAX_HZ,
        dynamic=True,
    ),
    Param("duty", 0.5, "share of the period with light", "", 0.001, 0.999, dynamic=True),
    Param("waveform", "square", "shape of the gate", choices=WAVEFORMS, dynamic=True),
    Param("arm_timeout", 10.0, "how long laser/arm allows laser/enable", "s", 0.1, 3600.0),
    Param("heartbeat_timeout", 1.0, "age at which the heartbeat is stale", "s", 0.1, 60.0),
    Param("max_on_time", 600.0, "longest time on", "s", 0.1, 86400.0),
    *drivers.LASER_TABLE,
)


class LaserNode(DeviceNode):
    """``laser/arm``, ``laser/enable``, ``laser/heartbeat``, ``laser/interlock`` -> ``laser/state``.

    ``laser/interlock`` (std_msgs/Bool): true means open, and open means dark; taken as closed
    until a message says otherwise. A watchdog thread on the steady clock switches off on a stale
    heartbeat, an open interlock or ``max_on_time``, also when the executor is stuck.
    """

    def __init__(self, **kwargs: Any) -> None:
        self._lock = threading.RLock()
        self._laser: LaserModulator | None = None
        self._requested = LaserOutput.OFF
        self._reason = "off at start"
        self._watchdog_end = threading.Event()
        self._watchdog: threading.Thread | None = None
        self.switch_offs = 0
        super().__init__("laser", TABLE, self._apply, **kwargs)
        self._gate = self._new_gate()
        self._state = self.create_publisher(
            LaserState, "laser/state", qos.latched(qos.STATE_HISTORY)
        )
        control = MutuallyExclusiveCallbackGroup()
        self.create_service(Trigger, "laser/arm", self._on_arm, callback_group=control)
        self.create_service(SetBool, "laser/enable", self._on_enable, callback_group=control)
        self.create_subscription(Bool, "laser/interlock", self._on_interlock, qos.stream(10))
        self.create_subscription(Header, "laser/heartbeat", self._on_heartbeat, qos.stream(10))
        self.create_timer(1.0 / STATE_RATE_HZ, self._publish_state, clock=self.steady_clock)
        diagnostics.Diagnostics(self, self._report)

    def open_device(self) -> None:
        """Open the generator, dark, with the modulation of the parameters."""
        with self._lock:
            self._laser = drivers.make(drivers.LASERS, self.parameters, self.now_ns)
            self._laser.disable()
            self._laser.configure(_modulation(dict(self.parameters)))
            self._gate = self._new_gate()
            self._requested, self._reason = LaserOutput.OFF, "off at start"
            self._publish_state()
        self._watchdog_end.clear()
        self._watchdog = threading.Thread(target=self._watch, name="laser watchdog", daemon=True)
        self._watchdog.start()
        self.get_logger().info(f"{self._laser.identity.model} {self._laser.identity.serial}: off")

    def start_device(self) -> None:
        """From here on the laser may be switched on."""
        self._switch_off("ready")

    def stop_device(self) -> None:
        """Switch off."""
        self._switch_off("not active")

    def close_device(self) -> None:
        """Switch off and release the generator."""
        self._watchdog_end.set()
        if self._watchdog is not None and self._watchdog is not threading.current_thread():
            self._watchdog.join(1.0)
        with self._lock:
            laser, self._laser = self._laser, None
        if laser is not None:
            laser.close()

    def _new_gate(self) -> LaserGate:
        return LaserGate(
            self.parameters["arm_timeout"],
            self.parameters["heartbeat_timeout"],
            self.parameters["max_on_time"],
        )

    def _apply(self, values: dict[str, Any]) -> None:
        modulation = _modulation(values)
        with self._lock:
            if self._laser is not None:
                self._laser.configure(modulation)
                self._publish_state()

    def _on_arm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            response.success, response.message = self._attempted(self._arm)
            self._publish_state()
        return response

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            with self._lock:
                response.success, response.message = self._attempted(self._switch_on)
                self._publish_state()
        else:
            response.success, response.message = self._attempted(
                lambda: self._switch_off("switched off by request")
            )
        return response

    def _attempted(self, step: Any) -> tuple[bool, str]:
        try:
            step()
        except EschortyError as error:
            self.get_logger().warning(str(error))
            return False, str(error)
        return True, self._reason

    def _arm(self) -> None:
        laser = self._active_laser()
        if self._gate.interlock_open:
            raise DeviceError("laser refused: interlock open; close it")
        laser.arm()
        self._gate.arm()
        self._reason = "armed"

    def _switch_on(self) -> None:
        laser = self._active_laser()
        refusal = self._gate.refusal()
        if refusal is not None:
            raise DeviceError(f"laser refused: {refusal}")
        self._requested = LaserOutput.ON
        try:
            self._gate.switched_on()
            laser.enable()
        except EschortyError as error:
            self._switch_off(str(error))
            raise
        self._reason = "switched on by request"

    def _active_laser(self) -> LaserModulator:
        if self._laser is None or not self.active:
            raise DeviceError(f"laser refused: node is {self.state_label}; activate it first")
        return self._laser

    def _switch_off(self, reason: str) -> None:
        """Off first, everything else after."""
        with self._lock:
            if self._laser is None:
                return
            try:
                self._laser.disable()
            finally:
                if self._requested == LaserOutput.ON:
                    self.switch_offs += 1
                self._gate.switched_off()
                self._requested, self._reason = LaserOutput.OFF, reason
            self._publish_state()

    def _watch(self) -> None:
        while not self._watchdog_end.wait(WATCHDOG_PERIOD_S):
            with self._lock:
                reason = self._gate.must_end()
                if reason is None:
                    continue
                try:
                    self._switch_off(reason)
                except EschortyError as error:
                    self.fault(f"laser state unknown: {error}")
                    continue
            with contextlib.suppress(Exception):
                self.get_logger().warning(f"laser off: {reason}")

    def _on_interlock(self, message: Bool) -> None:
        with self._lock:
            self._gate.interlock_open = bool(message.data)
        if message.data:
            self._switch_off("interlock open")
        else:
            self._publish_state()

    def _on_heartbeat(self, _: Header) -> None:
        with self._lock:
            self._gate.beat()

    def _publish_state(self) -> None:
        """Under the lock, so that stamp and state agree and every change is told."""
        if not self.context.ok():
            return
        try:
            with self._lock:
                if self._laser is not None:
                    self._state.publish(self._state_message(self._laser))
        except EschortyError as error:
            self.fault(f"laser state unknown: {error}")
        except Exception:
            # A signal may end the context between the check and the publication.
            if self.context.ok():
                raise

    def _state_message(self, laser: LaserModulator) -> LaserState:
        stamp_ns = self.now_ns()
        state = laser.readback()
        message = LaserState(
            requested=int(self._requested),
            output=int(state.output),
            armed=self._gate.armed,
            interlock_open=self._gate.interlock_open,
            waveform=state.modulation.waveform,
            frequency=state.modulation.frequency_hz,
            duty=state.modulation.duty,
            phase_epoch=stamp_from_ns(state.phase_epoch_ns or 0),
            output_since=stamp_from_ns(state.output_since_ns),
            reason=self._reason,
        )
        message.header.stamp = stamp_from_ns(stamp_ns)
        return message

    def _report(self) -> diagnostics.Report:
        with self._lock:
            laser = self._laser
            output = LaserOutput.OFF
            if laser is not None:
                try:
                    output = laser.readback().output
                except EschortyError:
                    output = LaserOutput.UNKNOWN
            values = {
                "device": laser.identity.model if laser is not None else "",
                "state": self.state_label,
                "output": output.name,
                "requested": self._requested.name,
                "armed": self._gate.armed,
                "interlock_open": self._gate.interlock_open,
                "reason": self._reason,
                "switch_offs": self.switch_offs,
            }
        if self.failure:
            return diagnostics.ERROR, self.failure, values
        mismatch = output != self._requested
        level = diagnostics.WARN if mismatch or self._gate.interlock_open else diagnostics.OK
        return level, f"{output.name}: {self._reason}", values


def _modulation(values: dict[str, Any]) -> Modulation:
    return Modulation(values["frequency"], values["duty"], values["waveform"])


def main() -> None:
    """Entry point of the laser node."""
    sys.exit(run(LaserNode))


if __name__ == "__main__":
    main()
