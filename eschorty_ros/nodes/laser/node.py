"""Laser node: gates the line through its generator, dark unless every condition for light holds."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.control.laser_interlock import LEASE, LaserGate
from eschorty_ros.control.laser_readback import LaserSnapshot
from eschorty_ros.control.laser_supervisor import LaserKeeper
from eschorty_ros.core.base.errors import ArgumentError, DeviceError, EschortyError
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ, WAVEFORMS, Modulation
from eschorty_ros.emulation.bench.folder import usb_spec
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.hardware.laser.awg_settings import AwgSettings
from eschorty_ros.hardware.laser_guard.guarded import GuardedLaser
from eschorty_ros.msg import LaserState
from eschorty_ros.nodes.ros import diagnostics, drivers, qos
from eschorty_ros.nodes.ros.conversions import stamp_from_ns
from eschorty_ros.nodes.ros.lifecycle import DeviceNode
from eschorty_ros.nodes.ros.parameters import Param, from_settings
from eschorty_ros.nodes.ros.spin import run

STATE_RATE_HZ = 20.0
THREADS = 4
WATCHED = ("camera", "stage")

DRIVER_TABLE = from_settings(AwgSettings)
TABLE = (
    *drivers.DRIVER,
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
    Param("heartbeat_timeout", 1.0, "age at which laser/heartbeat is stale", "s", 0.05, 60.0),
    Param("max_on_time", 600.0, "longest time on", "s", 0.1, 86400.0),
    Param("interlock_required", False, "interlock is open unless laser/interlock says closed"),
    Param("interlock_timeout", 1.0, "age at which a required 'closed' is stale", "s", 0.05, 60.0),
    Param("watch", " ".join(WATCHED), "nodes whose heartbeats light needs: camera, stage, none"),
    Param("camera_timeout", 1.0, "age at which camera/heartbeat is stale", "s", 0.05, 60.0),
    Param("stage_timeout", 1.0, "age at which stage/heartbeat is stale", "s", 0.05, 60.0),
    Param("readback_rate", 5.0, "how often the generator is read back", "Hz", 0.1, 20.0),
    *DRIVER_TABLE,
)


class LaserNode(DeviceNode):
    """``laser/arm``, ``laser/enable``, ``laser/heartbeat``, ``laser/interlock`` -> ``laser/state``.

    ``laser/interlock`` (std_msgs/Bool): true means open, and open means dark. With
    ``interlock_required`` it is open unless a message within ``interlock_timeout`` says closed,
    else closed until one says open. Light ends when
    ``laser/heartbeat`` (whoever wants light), ``camera/heartbeat`` or ``stage/heartbeat`` is stale
    or its sender on this host dies, with an open interlock, after ``max_on_time``, and when the
    generator does not read back as asked. This is looked after by threads on the steady clock,
    also when the executor is stuck. Spin it with several threads: commands take their time,
    heartbeats do not wait.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("laser", TABLE, self._apply, **kwargs)
        self._state = self.create_publisher(
            LaserState, "laser/state", qos.latched(qos.STATE_HISTORY)
        )
        gate = self._new_gate()
        self._keeper = LaserKeeper(
            gate,
            living=self.context.ok,
            changed=self._publish,
            alarm=self._alarm,
            log=self._log,
            readback_period_s=1.0 / self.parameters["readback_rate"],
        )
        # Switching off must not wait for a command under way; the keeper keeps them in order.
        control = ReentrantCallbackGroup()
        self.create_service(Trigger, "laser/arm", self._on_arm, callback_group=control)
        self.create_service(SetBool, "laser/enable", self._on_enable, callback_group=control)
        signs = MutuallyExclusiveCallbackGroup()
        self.create_subscription(
            Bool, "laser/interlock", self._on_interlock, qos.stream(10), callback_group=signs
        )
        for topic in gate.topics:
            self.create_subscription(
                Header,
                topic,
                partial(self._on_heartbeat, topic),
                qos.heartbeat(),
                callback_group=signs,
            )
        self.create_timer(1.0 / STATE_RATE_HZ, self._keeper.tell, clock=self.steady_clock)
        diagnostics.Diagnostics(self, self._report)

    def open_device(self) -> None:
        """Open the generator, dark, with the modulation of the parameters."""
        laser = drivers.make(
            "laser",
            _make_laser,
            lambda bench: {"backend": usb_spec(bench)},
            self.parameters,
            self.now_ns,
        )
        self._keeper.open(laser, _modulation(dict(self.parameters)))
        self.get_logger().info(f"{laser.identity.model} {laser.identity.serial}: off")

    def start_device(self) -> None:
        """From here on the laser may be switched on."""
        self._keeper.switch_off("ready")

    def stop_device(self) -> None:
        """Switch off; an output that nobody confirms is told as unknown."""
        try:
            self._keeper.switch_off(self.failure or "not active")
        except EschortyError as error:
            self._alarm(str(error))

    def close_device(self) -> None:
        """Switch off and release the generator; see ``stop_device``."""
        try:
            self._keeper.close()
        except EschortyError:
            self._alarm(self._keeper.unknown)

    def _new_gate(self) -> LaserGate:
        timeouts = {LEASE: self.parameters["heartbeat_timeout"]}
        names = self.parameters["watch"].replace(",", " ").split()
        for name in names if names != ["none"] else ():
            if name not in WATCHED:
                raise ArgumentError(
                    f"parameter watch is {self.parameters['watch']!r}; "
                    f"choose from {', '.join(WATCHED)}, or none"
                )
            timeouts[f"{name}/heartbeat"] = self.parameters[f"{name}_timeout"]
        return LaserGate(
            self.parameters["arm_timeout"],
            self.parameters["max_on_time"],
            timeouts,
            interlock_timeout_s=(
                self.parameters["interlock_timeout"]
                if self.parameters["interlock_required"]
                else math.inf
            ),
        )

    def _apply(self, values: dict[str, Any]) -> None:
        self._keeper.configure(_modulation(values))

    def _on_arm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self._attempted(self._arm)
        return response

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        step = self._enable if request.data else self._disable
        response.success, response.message = self._attempted(step)
        return response

    def _attempted(self, step: Callable[[], str]) -> tuple[bool, str]:
        try:
            return True, step()
        except EschortyError as error:
            self.get_logger().warning(str(error))
            return False, str(error)

    def _arm(self) -> str:
        self._refuse_inactive()
        self._keeper.arm()
        return "armed"

    def _enable(self) -> str:
        self._refuse_inactive()
        self._keeper.enable()
        return "switched on by request"

    def _disable(self) -> str:
        reason = "switched off by request"
        try:
            self._keeper.switch_off(reason)
        except EschortyError as error:
            self._alarm(str(error))
            raise
        return reason

    def _refuse_inactive(self) -> None:
        if not self.active:
            raise DeviceError(f"laser refused: node is {self.state_label}; activate it first")

    def _on_interlock(self, message: Bool) -> None:
        gate = self._keeper.gate
        opens = message.data and not gate.interlock_open
        gate.interlock_open = bool(message.data)
        # Said again it is no news; the watchdog looks at it all the time.
        if opens:
            self._keeper.darken("interlock open")
        self._keeper.tell()

    def _on_heartbeat(self, topic: str, message: Header) -> None:
        self._keeper.gate.beat(topic, message.frame_id)

    def _alarm(self, text: str) -> None:
        # As in _log.
        with contextlib.suppress(Exception):
            self.fault(text)

    def _log(self, text: str) -> None:
        # On the way out there may be nobody left to tell.
        with contextlib.suppress(Exception):
            self.get_logger().warning(text)

    def _publish(self, snapshot: LaserSnapshot) -> None:
        """Under the keeper's lock, so that stamp and state agree and every change is told."""
        if not self.context.ok():
            return
        told, gate = snapshot.told, self._keeper.gate
        message = LaserState(
            requested=int(snapshot.requested),
            output=int(told.output),
            armed=gate.armed,
            interlock_open=gate.interlock_open,
            waveform=told.modulation.waveform,
            frequency=told.modulation.frequency_hz,
            duty=told.modulation.duty,
            phase_epoch=stamp_from_ns(told.phase_epoch_ns or 0),
            output_since=stamp_from_ns(told.output_since_ns),
            reason=snapshot.reason,
        )
        message.header.stamp = stamp_from_ns(self.now_ns())
        try:
            self._state.publish(message)
        except Exception:
            # A signal may end the context between the check and the publication.
            if self.context.ok():
                raise

    def _report(self) -> diagnostics.Report:
        keeper = self._keeper
        snapshot = keeper.snapshot()
        output = snapshot.told.output if snapshot is not None else LaserOutput.OFF
        values: dict[str, Any] = {
            "device": keeper.device,
            "state": self.state_label,
            "output": output.name,
            "requested": snapshot.requested.name if snapshot is not None else "OFF",
            "armed": keeper.gate.armed,
            "interlock_open": keeper.gate.interlock_open,
            "reason": snapshot.reason if snapshot is not None else "",
            "switch_offs": keeper.switch_offs,
        }
        if snapshot is not None:
            values |= snapshot.told.counters
        for topic, gap_s in keeper.gate.gap_max_s.items():
            values[f"{topic} longest gap, s"] = gap_s
        if keeper.unknown:
            return diagnostics.ERROR, keeper.unknown, values
        if self.failure:
            return diagnostics.ERROR, self.failure, values
        if snapshot is None:
            return diagnostics.OK, self.state_label, values
        level = diagnostics.WARN if keeper.gate.interlock_open else diagnostics.OK
        return level, f"{output.name}: {snapshot.reason}", values


def _make_laser(parameters: Mapping[str, Any], _: drivers.ClockNs) -> GuardedLaser:
    settings = {param.name: parameters[param.name] for param in DRIVER_TABLE}
    # Refused here, before a process is started for it.
    AwgSettings(**settings)
    return GuardedLaser("eschorty_ros.hardware.laser.awg:open_laser", settings)


def _modulation(values: dict[str, Any]) -> Modulation:
    return Modulation(values["frequency"], values["duty"], values["waveform"])


def main() -> None:
    """Entry point of the laser node."""
    sys.exit(run(LaserNode, threads=THREADS))


if __name__ == "__main__":
    main()
