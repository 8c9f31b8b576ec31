"""Camera node: raw EVT3 as event packets, and the sensor clock's zero."""

from __future__ import annotations

import array
import contextlib
import sys
import threading
from typing import Any

from event_camera_msgs.msg import EventPacket
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import TimeReference

from eschorty_ros.core.errors import DeviceError, EschortyError
from eschorty_ros.hardware.protocols import EventChunk, EventSource
from eschorty_ros.msg import LaserState, StageMotion
from eschorty_ros.nodes import diagnostics, drivers, qos
from eschorty_ros.nodes.conversions import ns_from_stamp, stamp_from_ns
from eschorty_ros.nodes.device_messages import plan_from_motion, readback_from_state
from eschorty_ros.nodes.lifecycle import DeviceNode
from eschorty_ros.nodes.packets import SIZE_MAX_BYTES, Packetizer
from eschorty_ros.nodes.parameters import Param
from eschorty_ros.nodes.spin import run
from eschorty_ros.simulation.fake_camera import FakeCamera
from eschorty_ros.simulation.presets import PRESETS
from eschorty_ros.simulation.world import BACKGROUND_HZ

READ_TIMEOUT_S = 0.02
STOP_TIMEOUT_S = 3.0
REPORT_DEPTH = 1000

TABLE = (
    drivers.DRIVER,
    Param("scene", "steps", "fake camera: what it looks at, a scene's name or a mesh file"),
    Param("calibration", "config_3", "fake camera: optical build, a name or a file"),
    Param("as_built", "", "fake camera: build as it really is; empty: as calibration says"),
    Param(
        "pixels",
        "paper",
        "fake camera: preset of the event pixels",
        choices=tuple(PRESETS),
    ),
    Param("seed", 1, "fake camera: seed of the pixels and of the noise", "", 0, 2**31 - 1),
    Param(
        "background_rate",
        BACKGROUND_HZ,
        "fake camera: background events of one pixel",
        "Hz",
        0.0,
        100.0,
    ),
    Param("frame_id", "eschorty_optical", "frame of the packets' headers"),
    Param("event_message_time_threshold", 0.004, "age at which a packet leaves", "s", 0.0, 1.0),
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
    """Topics ``camera/events`` and ``camera/clock``.

    A packet's stamp is the host time at which its first byte arrived. A simulated camera is told
    what ``laser/state`` and ``stage/motion`` say, with their stamps as the times until which they
    are final, so it sees both exactly, however late the messages come.
    """

    def __init__(self, **kwargs: Any) -> None:
        self._source: EventSource | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._seq = 0
        self._published_bytes = 0
        self._unheard_bytes = 0
        self._packet_rate = diagnostics.Rate()
        self._byte_rate = diagnostics.Rate()
        super().__init__("camera", TABLE, **kwargs)
        self._events = self.create_lifecycle_publisher(
            EventPacket,
            "camera/events",
            qos.events(),
            qos_overriding_options=qos.overridable(),
        )
        self._clock_reference = self.create_publisher(TimeReference, "camera/clock", qos.latched())
        reports = MutuallyExclusiveCallbackGroup()
        self.create_subscription(
            LaserState,
            "laser/state",
            self._on_laser,
            qos.latched(REPORT_DEPTH),
            callback_group=reports,
        )
        self.create_subscription(
            StageMotion,
            "stage/motion",
            self._on_stage,
            qos.stream(REPORT_DEPTH),
            callback_group=reports,
        )
        diagnostics.Diagnostics(self, self._report)

    def open_device(self) -> None:
        """Open the camera."""
        self._source = drivers.make(drivers.CAMERAS, self.parameters, self.now_ns)
        self._source.open()
        identity = self._source.identity
        self.get_logger().info(
            f"{identity.model} {identity.serial}, {self._source.width} x {self._source.height}"
        )

    def start_device(self) -> None:
        """Stream, and tell when the sensor's clock read zero."""
        source = self._source
        if source is None:
            raise DeviceError("camera refused: not open; configure it first")
        packetizer = Packetizer(
            round(self.parameters["event_message_time_threshold"] * 1e9),
            self.parameters["event_message_size_threshold"],
        )
        source.start()
        if isinstance(source, FakeCamera):
            reference = TimeReference(source=source.identity.serial)
            reference.header.stamp = stamp_from_ns(source.sensor_zero_ns())
            reference.header.frame_id = self.parameters["frame_id"]
            self._clock_reference.publish(reference)
        self._ending.clear()
        self._thread = threading.Thread(
            target=self._stream, args=(source, packetizer), name="camera stream", daemon=True
        )
        self._thread.start()

    def stop_device(self) -> None:
        """End streaming; what has been read is still published."""
        self._ending.set()
        if self._source is not None:
            self._source.stop()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(STOP_TIMEOUT_S)
            if thread.is_alive():
                raise DeviceError(f"the camera does not stop within {STOP_TIMEOUT_S:g} s")

    def close_device(self) -> None:
        """Release the camera."""
        source, self._source = self._source, None
        if source is not None:
            source.close()

    def _stream(self, source: EventSource, packetizer: Packetizer) -> None:
        try:
            while not self._ending.is_set():
                chunk = source.read(READ_TIMEOUT_S)
                if chunk is None:
                    ready = packetizer.push(b"", self.now_ns())
                else:
                    if chunk.gap or chunk.restarted:
                        self._break(source, packetizer, chunk)
                    ready = packetizer.push(chunk.data, chunk.arrival_ns)
                for stamp_ns, payload in ready:
                    self._publish(source, stamp_ns, payload)
            for stamp_ns, payload in packetizer.flush():
                self._publish(source, stamp_ns, payload)
        except EschortyError as error:
            if not self._ending.is_set():
                self.fault(f"camera lost: {error}")
        except Exception as error:
            # A signal ends the context while this thread may be publishing.
            if self.context.ok():
                self.fault(f"camera stream failed: {error!r}")

    def _break(self, source: EventSource, packetizer: Packetizer, chunk: EventChunk) -> None:
        """Tell downstream by the numbering: one left out is a loss, 0 a new stream."""
        for stamp_ns, payload in packetizer.flush():
            self._publish(source, stamp_ns, payload)
        self._seq = 0 if chunk.restarted else self._seq + 1

    def _publish(self, source: EventSource, stamp_ns: int, payload: bytes) -> None:
        if self._events.get_subscription_count() == 0:
            self._unheard_bytes += len(payload)
            return
        message = EventPacket(
            height=source.height,
            width=source.width,
            seq=self._seq,
            encoding="evt3",
            is_bigendian=False,
            events=array.array("B", payload),
        )
        message.header.stamp = stamp_from_ns(stamp_ns)
        message.header.frame_id = self.parameters["frame_id"]
        self._events.publish(message)
        self._seq += 1
        self._published_bytes += len(payload)

    def _on_laser(self, message: LaserState) -> None:
        if isinstance(self._source, FakeCamera):
            with self._refused():
                self._source.observe_laser(
                    readback_from_state(message), ns_from_stamp(message.header.stamp)
                )

    def _on_stage(self, message: StageMotion) -> None:
        if isinstance(self._source, FakeCamera):
            with self._refused():
                self._source.observe_stage(
                    plan_from_motion(message), ns_from_stamp(message.header.stamp)
                )

    @contextlib.contextmanager
    def _refused(self) -> Any:
        try:
            yield
        except EschortyError as error:
            self.get_logger().error(f"report refused: {error}")

    def _report(self) -> diagnostics.Report:
        source = self._source
        values: dict[str, Any] = {
            "device": source.identity.model if source is not None else "",
            "state": self.state_label,
            "seq": self._seq,
            "packets_per_s": self._packet_rate.read(self._seq),
            "bytes_per_s": self._byte_rate.read(self._published_bytes),
            "bytes_without_subscriber": self._unheard_bytes,
        }
        if source is not None:
            values |= source.statistics()
        if self.failure:
            return diagnostics.ERROR, self.failure, values
        return diagnostics.OK, "streaming" if self.active else self.state_label, values


def main() -> None:
    """Entry point of the camera node."""
    sys.exit(run(CameraNode))


if __name__ == "__main__":
    main()
