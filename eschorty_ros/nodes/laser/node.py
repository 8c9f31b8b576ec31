"""Laser node: modulates the laser through its generator, off unless every condition holds."""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT, LaserInterlock
from eschorty_ros.control.laser_readback import LaserStatus
from eschorty_ros.control.laser_supervisor import LaserSupervisor
from eschorty_ros.core.base.errors import ArgumentError, DeviceError, EschortyError
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ, WAVEFORMS, Modulation
from eschorty_ros.emulation.bench.folder import usb_spec
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.hardware.base.usb import open_backend
from eschorty_ros.hardware.laser.awg_settings import AwgSettings
from eschorty_ros.hardware.laser_guard.guarded import GuardedLaser
from eschorty_ros.msg import LaserState
from eschorty_ros.nodes.ros import diagnostics, drivers, qos
from eschorty_ros.nodes.ros.conversions import stamp_from_ns
from eschorty_ros.nodes.ros.executor import ShortGroup
from eschorty_ros.nodes.ros.lifecycle import DeviceNode
from eschorty_ros.nodes.ros.parameters import Param, from_settings, settings_of
from eschorty_ros.nodes.ros.peers import Publishers
from eschorty_ros.nodes.ros.spin import ends, run
from eschorty_ros.nodes.ros.steady_timer import steady_timer

# Every change and, with light, every read-back is published, too.
STATE_RATE_HZ = 2.0
THREADS = 4
_COMMANDS_MAX = THREADS - 2
_REFUSAL_LOG_S = 5.0
WATCHED = ("camera", "stage")

TABLE = (
    *drivers.table("laser"),
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
    Param("waveform", "square", "shape of the modulation", choices=WAVEFORMS, dynamic=True),
    Param("arm_timeout", 10.0, "how long laser/arm allows laser/enable", "s", 0.1, 3600.0),
    Param("heartbeat_timeout", 1.0, "age at which laser/heartbeat is stale", "s", 0.05, 60.0),
    Param("max_on_time", 600.0, "longest time on", "s", 0.1, 86400.0),
    Param("interlock_required", False, "interlock is open unless laser/interlock reports closed"),
    Param("interlock_timeout", 1.0, "age at which a source's 'closed' is stale", "s", 0.05, 60.0),
    Param("allowed_peers", "", "names of the nodes whose laser/heartbeat counts; empty = any"),
    Param("guard", "", "socket of a guard that runs as a service; empty: starts one of its own"),
    Param("watch", " ".join(WATCHED), "nodes whose heartbeats light needs: camera, stage, none"),
    Param("camera_timeout", 1.0, "age at which camera/heartbeat is stale", "s", 0.05, 60.0),
    Param("stage_timeout", 1.0, "age at which stage/heartbeat is stale", "s", 0.05, 60.0),
    Param("readback_rate", 5.0, "how often the generator is read back", "Hz", 0.1, 20.0),
    *from_settings(AwgSettings),
)


class LaserNode(DeviceNode):
    """``laser/arm``, ``laser/enable``, ``laser/heartbeat``, ``laser/interlock`` -> ``laser/state``.

    ``laser/interlock`` (std_msgs/Bool): true means open, and open means off, until every node that
    ever published it reports closed within ``interlock_timeout`` and ``laser/reset_interlock`` is
    called. ``interlock_required``: open, too, while no node has. The output is disabled when
    ``laser/heartbeat`` (of the client that had it enabled), ``camera/heartbeat`` or
    ``stage/heartbeat`` is stale or its sender on this host ends, with an open interlock, after
    ``max_on_time``, and when the generator does not read back as requested. Watchdog threads on the
    steady clock check this, also when the executor is stuck.
    Spin it with several threads: commands take their time, heartbeats must not wait for them.
    """

    SAFE_FIRST = True

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("laser", TABLE, self._apply, **kwargs)
        self._state = self.create_publisher(
            LaserState, "laser/state", qos.latched(qos.STATE_HISTORY)
        )
        interlock = self._new_interlock()
        self._supervisor = LaserSupervisor(
            interlock,
            running=self.context.ok,
            publish=self._publish,
            alarm=self._alarm,
            log=self._log,
            readback_period_s=1.0 / self.parameters["readback_rate"],
        )
        # Disabling must wait neither for a command in progress nor for a thread: the supervisor
        # orders the others, and not all threads may wait for them.
        self._commands = threading.BoundedSemaphore(_COMMANDS_MAX)
        self._refused = 0
        self._refusals_logged: dict[str, tuple[str, float]] = {}
        control = ReentrantCallbackGroup()
        self.create_service(Trigger, "laser/arm", self._on_arm, callback_group=control)
        self.create_service(SetBool, "laser/enable", self._on_enable, callback_group=control)
        self.create_service(
            Trigger, "laser/reset_interlock", self._on_reset, callback_group=control
        )
        self._contacts = Publishers(self, "laser/interlock")
        self._allowed = {
            name if name.startswith("/") else f"{self.get_namespace().rstrip('/')}/{name}"
            for name in self.parameters["allowed_peers"].replace(",", " ").split()
        }
        self.create_subscription(
            Bool,
            "laser/interlock",
            self._on_interlock,
            qos.stream(10),
            callback_group=MutuallyExclusiveCallbackGroup(),
        )
        heartbeats = ShortGroup()
        for topic in interlock.topics:
            self.create_subscription(
                Header,
                topic,
                partial(self._on_heartbeat, topic, Publishers(self, topic)),
                qos.heartbeat(),
                callback_group=heartbeats,
            )
        steady_timer(self, 1.0 / STATE_RATE_HZ, self._supervisor.report)
        diagnostics.Diagnostics(self, self._report)

    def open_device(self) -> None:
        """Open the generator, off, with the modulation of the parameters."""
        laser = drivers.make(
            _make_laser,
            lambda bench: {"backend": usb_spec(bench)},
            self.parameters,
            self.now_ns,
        )
        self._supervisor.open(laser, _modulation(dict(self.parameters)))
        self.get_logger().info(f"{laser.identity.model} {laser.identity.serial}: off")

    def start_device(self) -> None:
        """Disable once more; ``laser/enable`` is accepted from here on."""
        self._supervisor.disable("ready")

    def stop_device(self) -> None:
        """Disable; an output that is not confirmed off is reported as unknown."""
        try:
            ended = "its node was ended" if ends(self) else "not active"
            self._supervisor.disable(self.failure or ended)
        except EschortyError as error:
            self._alarm(str(error))

    def close_device(self) -> None:
        """Disable and release the generator; see ``stop_device``."""
        try:
            self._supervisor.close()
        except EschortyError:
            self._alarm(self._supervisor.unknown)

    def _new_interlock(self) -> LaserInterlock:
        timeouts = {CLIENT_HEARTBEAT: self.parameters["heartbeat_timeout"]}
        names = self.parameters["watch"].replace(",", " ").split()
        for name in names if names != ["none"] else ():
            if name not in WATCHED:
                raise ArgumentError(
                    f"parameter watch is {self.parameters['watch']!r}; "
                    f"choose from {', '.join(WATCHED)}, or none"
                )
            timeouts[f"{name}/heartbeat"] = self.parameters[f"{name}_timeout"]
        return LaserInterlock(
            self.parameters["arm_timeout"],
            self.parameters["max_on_time"],
            timeouts,
            contact_timeout_s=self.parameters["interlock_timeout"],
            contact_required=self.parameters["interlock_required"],
        )

    def _apply(self, values: dict[str, Any]) -> None:
        self._supervisor.configure(_modulation(values))

    def _on_arm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self._attempted("arm", self._arm)
        return response

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        name, step = ("enable", self._enable) if request.data else ("disable", self._disable)
        response.success, response.message = self._attempted(name, step)
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        refusal = self._supervisor.interlock.reset_contact(self._contacts.present())
        response.success = not refusal
        response.message = f"laser refused: {refusal}" if refusal else "interlock closed"
        self._supervisor.report()
        return response

    def _attempted(self, name: str, step: Callable[[], str]) -> tuple[bool, str]:
        try:
            return True, step()
        except EschortyError as error:
            self._note_refusal(name, str(error))
            return False, str(error)

    def _note_refusal(self, name: str, reason: str) -> None:
        """Count a refusal; log its reason, the same one of a command every 5 s only."""
        self._refused += 1
        logged, at_s = self._refusals_logged.get(name, ("", -math.inf))
        now_s = time.monotonic()
        if reason != logged or now_s - at_s > _REFUSAL_LOG_S:
            self._refusals_logged[name] = reason, now_s
            self.get_logger().warning(f"{reason} ({self._refused} refused so far)")

    def _arm(self) -> str:
        with self._accepted() as ticket:
            self._supervisor.arm(ticket)
        return "armed"

    def _enable(self) -> str:
        with self._accepted() as ticket:
            self._supervisor.enable(ticket)
        return "switched on by request"

    def _disable(self) -> str:
        reason = "switched off by request"
        try:
            self._supervisor.disable(reason)
        except EschortyError as error:
            self._alarm(str(error))
            raise
        return reason

    @contextlib.contextmanager
    def _accepted(self) -> Iterator[int]:
        # Before the state is looked at: leaving it disables, which voids the ticket.
        ticket = self._supervisor.ticket()
        if not self.active:
            raise DeviceError(f"laser refused: node is {self.state_label}; activate it first")
        if not self._commands.acquire(blocking=False):
            raise DeviceError(
                f"laser refused: {_COMMANDS_MAX} commands are under way; wait for their answers"
            )
        try:
            yield ticket
        finally:
            self._commands.release()

    def _on_interlock(self, message: Bool, info: Mapping[str, Any]) -> None:
        interlock = self._supervisor.interlock
        publisher, source = self._contacts.id(info), self._contacts.name(info)
        if message.data or source or not publisher:
            opens = message.data and not interlock.contact_open
            interlock.receive_contact(bool(message.data), source or publisher, publisher)
            # Only at the change; the watchdog checks the contact all the time.
            if opens:
                self._supervisor.trip(interlock.contact_fault())
        # A closed contact counts once its node is known, an open one at once.
        self._supervisor.report()

    def _on_heartbeat(
        self, topic: str, publishers: Publishers, message: Header, info: Mapping[str, Any]
    ) -> None:
        if topic == CLIENT_HEARTBEAT and self._allowed:
            name = publishers.name(info)
            if name not in self._allowed:
                self.get_logger().warning(
                    f"{topic} of {name or 'a nameless node'} ignored: not in allowed_peers",
                    throttle_duration_sec=5.0,
                )
                return
        self._supervisor.interlock.receive_heartbeat(topic, message.frame_id, publishers.id(info))

    def _alarm(self, text: str) -> None:
        with contextlib.suppress(Exception):
            self.fault(text)

    def _log(self, text: str) -> None:
        # During shutdown the logger may be gone.
        with contextlib.suppress(Exception):
            self.get_logger().warning(text)

    def _publish(self, status: LaserStatus) -> None:
        """Publish a status; the supervisor calls it in order, and loses none."""
        if not self.context.ok():
            return
        readback, interlock = status.readback, self._supervisor.interlock
        message = LaserState(
            requested=int(status.requested),
            output=int(readback.output),
            armed=interlock.armed,
            interlock_open=interlock.contact_open,
            waveform=readback.modulation.waveform,
            frequency=readback.modulation.frequency_hz,
            duty=readback.modulation.duty,
            output_since=stamp_from_ns(readback.output_since_ns),
            reason=status.reason,
        )
        message.header.stamp = stamp_from_ns(self.now_ns())
        try:
            self._state.publish(message)
        except Exception:
            # A signal may end the context between the check and the publication.
            if self.context.ok():
                raise

    def _report(self) -> diagnostics.Report:
        supervisor = self._supervisor
        interlock, status = supervisor.interlock, supervisor.status()
        values: dict[str, Any] = {
            "device": supervisor.device,
            "state": self.state_label,
            "output": (status.readback.output if status else LaserOutput.UNKNOWN).name,
            "requested": (status.requested if status else LaserOutput.OFF).name,
            "armed": interlock.armed,
            "interlock_open": interlock.contact_open,
            "interlock": interlock.contact_fault() or "closed",
            "foreign_heartbeats": interlock.foreign_heartbeats,
            "reason": status.reason if status else "",
            "switch_offs": supervisor.switch_offs,
            "refused": self._refused,
        }
        if status is not None:
            values |= status.readback.counters
        for topic, gap_s in interlock.gap_max_s.items():
            values[f"{topic} longest gap, s"] = gap_s
        failure = supervisor.unknown or self.failure
        if failure:
            return diagnostics.ERROR, failure, values
        if status is None:
            return diagnostics.OK, self.state_label, values
        level = diagnostics.WARN if interlock.contact_open else diagnostics.OK
        return level, f"{values['output']}: {status.reason}", values


def _make_laser(parameters: Mapping[str, Any], _: drivers.ClockNs) -> GuardedLaser:
    settings = settings_of(parameters, AwgSettings)
    # Refused here, before a process is started for it. What the backend imports is loaded then:
    # after the end of the guard there is no time for it.
    open_backend(settings.backend)
    return GuardedLaser(
        "eschorty_ros.hardware.laser.awg:open_laser", asdict(settings), guard=parameters["guard"]
    )


def _modulation(values: dict[str, Any]) -> Modulation:
    return Modulation(values["frequency"], values["duty"], values["waveform"])


def main() -> None:
    """Entry point of the laser node."""
    sys.exit(run(LaserNode, threads=THREADS))


if __name__ == "__main__":
    main()
