"""Camera node: raw EVT3 as event packets, and the camera's settings as parameters."""

from __future__ import annotations

import sys
import threading
from typing import Any

from event_camera_msgs.msg import EventPacket
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.core.base.numbers import number
from eschorty_ros.emulation.bench.folder import usb_spec
from eschorty_ros.hardware.base.protocols import DeviceIdentity, EventSource, LaserOutput
from eschorty_ros.hardware.camera import BIASES, save_bias_file
from eschorty_ros.live.packet_cutting import SIZE_MAX_BYTES
from eschorty_ros.msg import LaserState
from eschorty_ros.nodes.camera.packet_publisher import PacketPublisher
from eschorty_ros.nodes.camera.parameters import (
    EVK4_TABLE,
    camera_settings,
    make_camera,
    missing_bias_file,
    windows_given,
)
from eschorty_ros.nodes.ros import diagnostics, drivers, qos
from eschorty_ros.nodes.ros.frames import FRAME_PREFIX, frames
from eschorty_ros.nodes.ros.heartbeat import Heartbeat
from eschorty_ros.nodes.ros.lifecycle import DeviceNode
from eschorty_ros.nodes.ros.parameters import Param
from eschorty_ros.nodes.ros.spin import run

READ_TIMEOUT_S = 0.02
# Together with the packets of an emulated camera less than the age from which events count as late.
DARK_PAUSE_S = 0.05
STOP_TIMEOUT_S = 3.0
LATE_S = 0.1

_LOSSES = ("drops", "gaps", "sensor_drop_words", "erc_events_dropped")

TABLE = (
    *drivers.table("camera"),
    *EVK4_TABLE,
    FRAME_PREFIX,
    Param(
        "event_message_time_threshold",
        0.004,
        "age at which a packet leaves, one of under 8 kB at five times that, and at 25 times while "
        "laser/state is off and not armed",
        "s",
        0.0,
        1.0,
    ),
    Param(
        "event_message_size_threshold",
        128_000,
        "size at which a packet leaves",
        "bytes",
        2,
        SIZE_MAX_BYTES,
    ),
)


class CameraNode(DeviceNode):
    """Topic ``camera/events``; biases as parameters.

    A packet's stamp is the host time at which its first byte arrived. While a lost camera is
    searched for, the node stays active and reports an error; the stream then restarts at ``seq`` 0.
    """

    def __init__(self, **kwargs: Any) -> None:
        self._source: EventSource | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._laser_hz = 0.0
        self._rates = {name: diagnostics.Rate() for name in ("packets", "bytes", "on", "off")}
        self._biases: dict[str, int] = {}
        self._lost_reported = 0.0
        super().__init__("camera", TABLE, self._on_change, **kwargs)
        events = self.create_lifecycle_publisher(
            EventPacket,
            "camera/events",
            qos.events(),
            qos_overriding_options=qos.overridable(),
        )
        self._packets = PacketPublisher(events, frames(self.parameters["frame_prefix"]).optical)
        self.create_subscription(
            LaserState, "laser/state", self._on_laser, qos.latched(qos.STATE_HISTORY)
        )
        self.create_service(Trigger, "~/save_biases", self._save_biases)
        self.create_service(Trigger, "~/dump_statistics", self._dump_statistics)
        self._biases_changed = self.on_request(self._write_parameters)
        self._diagnostics = diagnostics.Diagnostics(self, self._report)
        Heartbeat(self, "camera/heartbeat", lambda: self.healthy)

    def open_device(self) -> None:
        """Open the camera."""
        self._source = drivers.make(
            make_camera,
            lambda bench: {"backend": usb_spec(bench)},
            self.parameters,
            self.now_ns,
        )
        self._source.on_loss = self._on_loss
        if not self.waiting:
            self.get_logger().info("looking for the camera; its initialisation takes 3 s")
        self._source.open()
        identity = self._source.identity
        self.get_logger().info(
            f"{identity.model} {identity.serial} {identity.firmware}, "
            f"{self._source.width} x {self._source.height}"
        )
        for line in (*self._source.warnings, missing_bias_file(self.parameters)):
            if line:
                self.get_logger().warning(line)
        self._biases = self._source.read_biases()
        self._write_parameters()

    def start_device(self) -> None:
        """Start to stream."""
        source = self._source
        if source is None:
            raise DeviceError("camera refused: not open; configure it first")
        self._packets.begin(
            source.width,
            source.height,
            round(self.parameters["event_message_time_threshold"] * 1e9),
            self.parameters["event_message_size_threshold"],
        )
        source.start()
        # One flag per thread: a hung thread must not resume when the next one starts.
        ending = self._ending = threading.Event()
        self._thread = threading.Thread(
            target=self._stream, args=(source, ending), name="camera stream", daemon=True
        )
        self._thread.start()

    def stop_device(self) -> None:
        """Stop streaming; data already read is still published."""
        self._ending.set()
        try:
            if self._source is not None:
                self._source.stop()
        finally:
            thread, self._thread = self._thread, None
            if thread is not None:
                thread.join(STOP_TIMEOUT_S)
        if thread is not None and thread.is_alive():
            raise DeviceError(
                f"the camera does not stop within {STOP_TIMEOUT_S:g} s; configure it again"
            )

    def close_device(self) -> None:
        """Release the camera."""
        source, self._source = self._source, None
        if source is not None:
            source.close()

    @property
    def healthy(self) -> bool:
        """Return whether the stream runs and the camera answers."""
        thread, source = self._thread, self._source
        running = thread is not None and thread.is_alive() and not self._ending.is_set()
        return running and source is not None and source.healthy

    def _stream(self, source: EventSource, ending: threading.Event) -> None:
        try:
            while not ending.is_set():
                # In the dark chunks collect in the queue: each one that is waited for costs a
                # change of threads.
                dark = self._packets.dark
                chunk = source.read(0.0 if dark else READ_TIMEOUT_S)
                self._packets.push(chunk, self.now_ns())
                if dark and chunk is None:
                    ending.wait(DARK_PAUSE_S)
            self._packets.flush()
        except EschortyError as error:
            if not ending.is_set():
                self.fault(f"camera lost: {error}")
        except Exception as error:
            # A signal ends the context while this thread may be publishing.
            if self.context.ok():
                self.fault(f"camera stream failed: {error!r}")

    def _on_loss(self, line: str) -> None:
        """Report a lost camera at once; runs in the driver's receiving thread."""
        if self.context.ok() and not self._ending.is_set():
            self.get_logger().error(f"camera lost, looking for it: {line}")
            self._diagnostics.publish()

    def _on_change(self, proposed: dict[str, Any]) -> None:
        """Set changed biases and windows; the offset read back becomes the parameter."""
        # All values are checked before the first is set.
        source, settings = self._source, camera_settings(proposed)
        if source is None:
            return
        changed = [name for name in BIASES if proposed[name] != self._biases.get(name)]
        try:
            for name in changed:
                self._biases[name] = source.set_bias(name, proposed[name])
            if settings.windows != windows_given(self.parameters):
                source.set_windows(settings.windows)
        finally:
            # The camera may have others than asked for, or, after an error, some of those.
            if changed:
                self._biases_changed()

    def _write_parameters(self) -> None:
        changed = [
            Parameter(name, value=offset)
            for name, offset in self._biases.items()
            if self.parameters[name] != offset
        ]
        if changed:
            self.set_parameters_atomically(changed)

    def _save_biases(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        path, source = self.parameters["bias_file"], self._source
        try:
            if not path:
                raise DeviceError("no file to save biases to; set the parameter bias_file")
            if source is None:
                raise DeviceError("no biases to save; the camera is not open")
            save_bias_file(path, source.read_biases())
        except EschortyError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f"biases saved to {path}"
        return response

    def _dump_statistics(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        source = self._source
        response.message = "the camera is not open; configure it first"
        if source is not None:
            response.success = True
            values = source.statistics() | self._packets.losses
            response.message = ", ".join(f"{name} {value:g}" for name, value in values.items())
        self.get_logger().info(f"statistics: {response.message}")
        return response

    def _on_laser(self, message: LaserState) -> None:
        self._laser_hz = number("frequency", message.frequency)
        off = message.output == message.requested == LaserOutput.OFF
        self._packets.dark = off and not message.armed

    def _report(self) -> diagnostics.Report:
        source, packets = self._source, self._packets
        identity = source.identity if source is not None else DeviceIdentity("", "")
        values: dict[str, Any] = {
            "device": identity.model,
            "serial": identity.serial,
            "firmware": identity.firmware,
            "state": self.state_label,
            "seq": packets.seq,
            "packets_per_s": self._rates["packets"].read(packets.packets),
            "bytes_per_s": self._rates["bytes"].read(packets.published_bytes),
            "on_events_per_s": self._rates["on"].read(packets.on),
            "off_events_per_s": self._rates["off"].read(packets.off),
            "trigger_edges": packets.trigger_edges,
            **packets.losses,
            "bytes_without_subscriber": packets.unsubscribed_bytes,
            "late_s": packets.late_s,
        }
        if source is not None:
            values |= source.statistics()
        lost = sum(values.get(name, 0) for name in _LOSSES)
        lost, self._lost_reported = lost - self._lost_reported, lost
        if self.failure:
            return diagnostics.ERROR, self.failure, values
        loss = source.loss if source is not None else ""
        if loss:
            return diagnostics.ERROR, f"looking for the camera: {loss}", values
        if source is not None and self._laser_hz and source.filters_out(self._laser_hz):
            line = (
                f"the anti-flicker filter erases the laser's {self._laser_hz:g} Hz; switch it off"
            )
            return diagnostics.WARN, line, values
        if lost > 0:
            which = ", ".join(f"{name} {values[name]:g}" for name in _LOSSES if values.get(name))
            return diagnostics.WARN, f"events were lost in the last second; so far {which}", values
        if self.active and packets.late_s > LATE_S:
            line = f"events come {packets.late_s:.1f} s late: this computer does not keep up"
            return diagnostics.WARN, line, values
        return diagnostics.OK, "streaming" if self.active else self.state_label, values


def main() -> None:
    """Entry point of the camera node."""
    # Opening takes seconds; another thread lets a signal cut it short.
    sys.exit(run(CameraNode, threads=2))


if __name__ == "__main__":
    main()
