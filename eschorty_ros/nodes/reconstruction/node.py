"""Node ``reconstruction``: event packets in, profiles, points and assembled scans out."""

from __future__ import annotations

import dataclasses
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from event_camera_msgs.msg import EventPacket
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import TimeReference
from tf2_msgs.msg import TFMessage

from eschorty_ros.core.base.errors import ArgumentError, EschortyError, FormatError
from eschorty_ros.core.optics import Calibration, load_calibration
from eschorty_ros.core.reconstruction import Settings, warm_up
from eschorty_ros.core.storage import ScanLog
from eschorty_ros.live.calibration_capture import Capture
from eschorty_ros.live.clock_steps import ClockSteps
from eschorty_ros.live.device_messages import laser_settings, ns_from_stamp, pulse_train
from eschorty_ros.live.job_queue import JobQueue
from eschorty_ros.live.packet_times import Packet
from eschorty_ros.live.pipeline import Pipeline
from eschorty_ros.live.scan_buffer import AssembledScan
from eschorty_ros.live.scan_recorder import ScanRecorder
from eschorty_ros.msg import LaserState, PositionTrigger
from eschorty_ros.nodes.reconstruction.active_calibration import ActiveCalibration
from eschorty_ros.nodes.reconstruction.auto_calibration import AutoCalibration
from eschorty_ros.nodes.reconstruction.calibrator import Calibrator
from eschorty_ros.nodes.reconstruction.camera_roi import CameraRoi
from eschorty_ros.nodes.reconstruction.inputs import packet_from_message
from eschorty_ros.nodes.reconstruction.outputs import POINTS_INTERVAL_S, Outputs
from eschorty_ros.nodes.reconstruction.parameters import (
    TABLE,
    check_recording,
    expanded_folder,
    modulation_override,
)
from eschorty_ros.nodes.reconstruction.reports import Reports
from eschorty_ros.nodes.reconstruction.scan_services import ScanServices
from eschorty_ros.nodes.ros import diagnostics, qos, transforms
from eschorty_ros.nodes.ros.border import refusals
from eschorty_ros.nodes.ros.conversions import stage_position_mm
from eschorty_ros.nodes.ros.executor import ShortGroup
from eschorty_ros.nodes.ros.frames import frames
from eschorty_ros.nodes.ros.heartbeat import Heartbeat
from eschorty_ros.nodes.ros.parameters import Parameters, settings_of
from eschorty_ros.nodes.ros.peers import LatchedState, OnePublisher, age_s, publishers_fault
from eschorty_ros.nodes.ros.spin import ends, run
from eschorty_ros.nodes.ros.steady_timer import steady_timer

_STAGE_DEPTH = 2000
_STATE_S = 0.2
# Longest wait for a job: short while packets, points or an image wait for a time, else long.
_WAITING_S, _IDLE_S = POINTS_INTERVAL_S, 1.0
# Packets that have queued up are worked on in parts: all together would take 100 MB for a second.
_JOBS_PER_STEP = 32
# A step costs as much as the events of some packets of 1 ms; they wait for each other this long.
_STEP_S = 0.003
# Loading the compiled kernels takes less.
_COMPILING_S = 5.0
# Longest time between two clocks that are read together.
_READ_NS = 1_000_000
_COMPILING = "compiling kernels, for some minutes at a first start; 'eschorty compile' does it"


class ReconstructionNode(Node):
    """Callbacks queue jobs; one worker thread computes and publishes."""

    def __init__(self, **kwargs: Any) -> None:
        self._camera, self._laser, self._stage = OnePublisher(), OnePublisher(), OnePublisher()
        # First, because a node whose constructor fails is destroyed, too.
        self._closing = threading.Event()
        self._worker = threading.Thread(target=self._work, name="reconstruction", daemon=True)
        super().__init__("reconstruction", **kwargs)
        self.parameters = Parameters(self, TABLE, self._on_change)
        self.calibration = load_calibration(self.parameters["calibration"])
        # As the worker uses them, which follows the parameters.
        self._settings = settings_of(self.parameters, Settings)
        slow = threading.Timer(_COMPILING_S, self.get_logger().info, (_COMPILING,))
        slow.start()
        try:
            warm_up(self.calibration, self._settings)
        finally:
            slow.cancel()
        self._override = modulation_override(self.parameters)
        check_recording(self.parameters)
        self._pipeline = Pipeline(
            self.calibration,
            self._settings,
            self.parameters["clock_timeout"],
            self.parameters["stage_gap"],
            self.parameters["stage_timeout"],
            self.parameters["packet_period"],
        )
        self._pipeline.stream.set_override(self._override)
        self._frames = frames(self.parameters["frame_prefix"])
        self._outputs = Outputs(
            self, self.calibration, self.parameters["profile_rate_max"], self._frames
        )
        self._clock_steps = ClockSteps()
        self._jobs = JobQueue(self.parameters["packets_max"])
        self._reports = Reports(self, self._pipeline, self._jobs)
        self._camera_roi = CameraRoi(self, self.parameters["camera_roi"] == "follow")
        self._camera_roi.follow(self._settings, self.calibration.model())
        self._calibrator = self._made_calibrator()
        self._make_interfaces()
        self.get_logger().info(self._sources())
        if self.parameters["auto_calibrate"]:
            names = ("distances", "method", "capture_time")
            self._auto = AutoCalibration(self, *(self.parameters[name] for name in names))
        self._worker.start()

    def _sources(self) -> str:
        """Return what the points are made from."""
        events, odom, laser = map(
            self.resolve_topic_name, ("camera/events", "stage/odom", "laser/state")
        )
        modulation = f"{self._override.frequency_hz:g} Hz" if self._override else laser
        return (
            f"calibration {self.calibration.label}, modulation {modulation}, trigger source "
            f"{self.parameters['trigger_source']}, events {events}, stage {odom}"
        )

    def _made_calibrator(self) -> Calibrator:
        values = self.parameters
        return Calibrator(
            self,
            ActiveCalibration(
                self,
                self.calibration,
                values["calibration"],
                values["calibration_folder"],
                values["calibration_paths"],
                self._use_calibration,
            ),
            self._in_worker,
            self._set_capture,
            lambda: float(values["line_width_px"]),
            self._frames.optical,
            (values["node_timeout"], values["service_timeout"], values["events_timeout"]),
        )

    def _make_interfaces(self) -> None:
        override = {"qos_overriding_options": qos.overridable()}
        short = ShortGroup()
        self.create_subscription(EventPacket, "camera/events", self._on_packet,
                                 qos.events(), callback_group=short, raw=True,
                                 **override)  # fmt: skip
        stream = self._pipeline.stream
        self._announcement = LatchedState(
            self, TimeReference, "camera/clock", self._on_clock,
            lambda: self._post(stream.drop_zero), short,
        )  # fmt: skip
        LatchedState(
            self, PositionTrigger, "stage/trigger", self._on_trigger,
            lambda: self._post(partial(stream.set_pulses, None)), short,
        )  # fmt: skip
        self.create_subscription(LaserState, "laser/state", self._on_laser,
                                 qos.latched(qos.STATE_HISTORY), callback_group=short)  # fmt: skip
        self.create_subscription(
            Odometry,
            "stage/odom",
            self._on_stage,
            qos.stream(_STAGE_DEPTH),
            callback_group=short,
            **override,
        )
        Heartbeat(self, "reconstruction/heartbeat", lambda: self._running() and not ends(self))
        self._scans = ScanServices(
            self,
            self._pipeline,
            self._scan_fault,
            self._in_worker,
            self._running,
            self.parameters["stage_timeout"],
            self._publish_scan,
            self._recorder,
        )
        self._tf: Any = None
        if self.parameters["publish_tf"]:
            self._tf = self.create_publisher(TFMessage, "/tf", qos.stream(100))
            self._tf_static = self.create_publisher(TFMessage, "/tf_static", qos.latched())
            now_ns = self.get_clock().now().nanoseconds
            self._tf_static.publish(TFMessage(transforms=transforms.mounts(self._frames, now_ns)))
        steady_timer(self, _STATE_S, self._reports.publish_state, short)
        self._diagnostics = diagnostics.Diagnostics(self, self._reports.diagnose, short)

    def safe_state(self) -> None:
        """End a calibration under way: on its way out the laser goes off."""
        self._calibrator.safe_state()

    def destroy_node(self) -> None:
        """Stop the worker, then the node."""
        self._closing.set()
        if self._worker.is_alive():
            self._jobs.post(lambda: None)
            self._worker.join(timeout=5.0)
            self._scans.end_recording()
        super().destroy_node()

    # Callbacks: queue and return.

    def _on_packet(self, message: bytes, info: Mapping[str, Any]) -> None:
        try:
            packet = packet_from_message(message, self._camera.check(info), self.calibration)
        except EschortyError as error:
            self._jobs.post_later(partial(self._pipeline.note_refused, str(error)))
            raise
        self._reports.packet_ages.add(age_s(self, info, packet.stamp_ns))
        self._jobs.post_bulk(partial(self._add_packet, packet))

    def _on_clock(self, message: TimeReference) -> None:
        zero_ns = ns_from_stamp(message.header.stamp) - ns_from_stamp(message.time_ref)
        self._post(partial(self._pipeline.stream.announce_zero, zero_ns))

    def _on_laser(self, message: LaserState, info: Mapping[str, Any]) -> None:
        self._laser.check(info)
        self._post(partial(self._pipeline.stream.set_laser, *laser_settings(message)))

    def _on_trigger(self, message: PositionTrigger) -> None:
        self._post(partial(self._pipeline.stream.set_pulses, pulse_train(message)))

    def _on_stage(self, message: Odometry, info: Mapping[str, Any]) -> None:
        self._stage.check(info)
        t_ns, position_mm = ns_from_stamp(message.header.stamp), stage_position_mm(message)
        # What waits for a position waits for the next cloud of points, too.
        self._jobs.post_later(partial(self._pipeline.add_stage, t_ns, position_mm))
        if self._tf is not None and self._tf.get_subscription_count():
            x, y, z = self.calibration.stage_direction
            carriage = transforms.carriage(self._frames, t_ns, position_mm, (x, y, z))
            self._tf.publish(TFMessage(transforms=[carriage]))

    def _post(self, job: Callable[[], None]) -> None:
        """Queue a job that takes effect between the packets before and after it."""
        self._jobs.post(partial(self._after_packets, job))

    def _after_packets(self, job: Callable[[], None]) -> None:
        self._pipeline.process(time.monotonic())
        job()

    def _in_worker(self, job: Callable[[], None], timeout_s: float = 30.0) -> tuple[bool, str]:
        """Run ``job`` after the queued ones; return whether it succeeded, and the reason if not."""
        return self._jobs.run(partial(self._after_packets, job), timeout_s, self._running)

    def _running(self) -> bool:
        """Return whether the worker runs; after a signal it does not."""
        return not self._closing.is_set() and self.context.ok()

    def _use_calibration(self, calibration: Calibration) -> None:
        def use() -> None:
            self._pipeline.set_calibration(calibration)
            self.calibration = calibration
            self._camera_roi.follow(self._settings, calibration.model())

        done, reason = self._in_worker(use)
        if not done:
            raise ArgumentError(f"calibration not exchanged: {reason}")

    def _set_capture(self, capture: Capture | None) -> None:
        if capture is not None:
            self._camera_roi.check_full()
        self._pipeline.set_capture(capture)

    def _scan_fault(self) -> tuple[str, bool]:
        """Return why no scan can begin, ``""`` when one can, and whether that may pass.

        A node that was killed counts as a publisher for some time.
        """
        topics = ["camera/events", "stage/odom", *([] if self._override else ["laser/state"])]
        faults = {topic: publishers_fault(self, topic) for topic in topics}
        pause = self._stage.pause_fault(self, "stage/odom")
        names = map(self.resolve_topic_name, topics)
        several = any(self.count_publishers(name) > 1 for name in names)
        message = "; ".join(fault for fault in (*faults.values(), pause) if fault)
        return message, several or bool(faults["stage/odom"] or pause)

    def _publish_scan(self, scan: AssembledScan) -> None:
        self._outputs.scan(scan, self.parameters["organized"] == "on")

    def _recorder(
        self, scan_id: str, start_mm: float, stop_mm: float, passes: int, speed_mm_s: float
    ) -> ScanRecorder | None:
        """Return a recorder of a scan, ``None`` unless the parameter ``record`` is set."""
        values = self.parameters
        if not values["record"]:
            return None
        parent = expanded_folder("record", values["record"])
        path = parent / (values["record_name"] or scan_id)
        if path in self._scans.recordings:
            path = parent / scan_id
        log = ScanLog(
            scan_id=scan_id,
            start_mm=start_mm,
            stop_mm=stop_mm,
            passes=passes,
            speed_mm_s=speed_mm_s,
            stage_gap_s=float(values["stage_gap"]),
        )
        settings = dataclasses.asdict(settings_of(values, Settings))
        return ScanRecorder(path, log, self.calibration, settings)

    # The worker.

    def _work(self) -> None:
        stepped_s = 0.0
        while not self._closing.wait(max(stepped_s + _STEP_S - time.monotonic(), 0.0)):
            stepped_s = time.monotonic()
            try:
                job, begun = self._jobs.next(_WAITING_S if self._waits() else _IDLE_S), 0
                while job is not None:
                    job()
                    begun += 1
                    job = self._jobs.next(0.0) if begun < _JOBS_PER_STEP else None
                self._step()
            except Exception:
                # After a signal the context is invalid.
                if not self._running():
                    return
                self._reports.faults += 1
                self.get_logger().error(traceback.format_exc(), throttle_duration_sec=1.0)

    def _add_packet(self, packet: Packet) -> None:
        stream = self._pipeline.stream
        if stream.epoch is None:
            # Asked by name: the subscription may be replaced meanwhile.
            topic = self._announcement.subscription.topic_name
            stream.announcement_expected = self.count_publishers(topic) > 0
        try:
            self._pipeline.add_packet(packet, time.monotonic())
        except FormatError as error:
            refusals(self).add("camera/events", str(error))
            return
        self._outputs.packet(packet.data)

    def _waits(self) -> bool:
        """Return whether something waits for more than the next job."""
        pipeline = self._pipeline
        return bool(pipeline.stream.held or pipeline.placer.waiting or self._outputs.waits)

    def _follow_clock(self) -> None:
        """Compare the computer's clock with the steady one, unless ROS time is simulated."""
        before_ns = time.monotonic_ns()
        lead_ns = time.time_ns() - before_ns
        # Otherwise the process stalled between the two.
        if time.monotonic_ns() - before_ns > _READ_NS:
            return
        step_ns = self._clock_steps.step_ns(lead_ns, before_ns * 1e-9)
        if not step_ns or self.get_parameter("use_sim_time").value:
            return
        if self._pipeline.follow_clock(step_ns):
            self.get_logger().warning(
                f"the clock was set by {step_ns * 1e-9:+.3f} s; the camera's starts again",
                throttle_duration_sec=1.0,
            )

    def _use_settings(self, settings: Settings) -> None:
        self._settings = settings
        self._pipeline.stream.set_settings(settings)
        # Here, as the calibration is exchanged in this thread, too.
        self._camera_roi.follow(settings, self.calibration.model())

    def _step(self) -> None:
        self._follow_clock()
        # A profile leaves before its points are placed, which it does not need.
        self._outputs.profiles(self._pipeline.complete(time.monotonic()))
        if self._outputs.points_due:
            self._outputs.points(self._pipeline.place(time.monotonic()))
        until_ns = self._pipeline.stream.processed_until_ns
        if until_ns is not None:
            self._outputs.event_frame(until_ns)
        self._scans.finish()

    def _on_change(self, values: dict[str, Any]) -> None:
        check_recording(values)
        settings = settings_of(values, Settings)
        override = modulation_override(values)
        self._post(partial(self._use_settings, settings))
        self._jobs.post(partial(self._pipeline.placer.set_gap, values["stage_gap"]))
        self._override = override
        self._post(partial(self._pipeline.stream.set_override, override))


def main() -> int:
    """Run the node."""
    return run(ReconstructionNode, threads=6)


if __name__ == "__main__":
    sys.exit(main())
