"""Node ``replay``: publishes a recording on the topics of camera, laser and stage."""

from __future__ import annotations

import math
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from event_camera_msgs.msg import EventPacket
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import TimeReference

from eschorty_ros.core.base.errors import ArgumentError, DeviceError, EschortyError
from eschorty_ros.core.clocks import NS_PER_US
from eschorty_ros.core.reconstruction import Settings, stage_speed_mm_s
from eschorty_ros.core.storage import Recording, load_recording
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.live.bag_files import is_bag
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.live.recorded_packets import TimedPacket, timed_packets
from eschorty_ros.msg import LaserState, ReconstructionState
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.conversions import m_from_mm, odometry, stamp_from_ns
from eschorty_ros.nodes.ros.frames import FRAME_PREFIX, frames
from eschorty_ros.nodes.ros.parameters import Param, Parameters
from eschorty_ros.nodes.ros.repeated_call import RepeatedCall
from eschorty_ros.nodes.ros.spin import run, unless_shut_down
from eschorty_ros.nodes.ros.steady_timer import steady_timer
from eschorty_ros.srv import BeginScan, EndScan

TABLE = (
    Param("recording", "", "recording folder"),
    Param("rate", 1.0, "speed against real time; 0 is as fast as possible", "", 0.0, 1e6),
    Param("timeout", 30.0, "longest wait for the reconstruction and for its progress", "s",
          0.1, 3600.0),
    FRAME_PREFIX,
)  # fmt: skip

_PACKETS_AHEAD = 256
_ROWS_AHEAD = 1000
_POLL_S = 0.005
_SILENT_S = 2.0
_STATE_S = 0.5
_INTERRUPTED = 130


class ReplayNode(Node):
    """Publishes a recording once as one scan of the reconstruction, and ends the process.

    The stamps are the recording's times, shifted to begin at the present ROS time; the rate does
    not change them. The node stays at most a bounded number of messages ahead of the
    reconstruction, so that a reliable subscription loses nothing.

    - ``played``: Set when all is published and the scan has ended.
    """

    def __init__(self, played: threading.Event, **kwargs: Any) -> None:
        # First, because a node whose constructor fails is destroyed, too.
        self._played = played
        self._closing = threading.Event()
        self._player = threading.Thread(target=self._run, name="replay", daemon=True)
        super().__init__("replay", **kwargs)
        self.parameters = Parameters(self, TABLE)
        self._frames = frames(self.parameters["frame_prefix"])
        if not self.parameters["recording"]:
            raise ArgumentError("parameter recording is empty; give a recording folder")
        path = Path(self.parameters["recording"])
        if is_bag(path):
            raise ArgumentError(f"{path} is a bag; eschorty convert makes a recording of it")
        self._recording: Recording = load_recording(path)
        self._reader = RawReader(self._recording.events_path)
        self._events = self.create_publisher(
            EventPacket, "camera/events", qos.stream(qos.EVENT_DEPTH)
        )
        self._clock_reference = self.create_publisher(TimeReference, "camera/clock", qos.latched())
        self._laser = self.create_publisher(
            LaserState, "laser/state", qos.latched(qos.STATE_HISTORY)
        )
        self._odom = self.create_publisher(Odometry, "stage/odom", qos.stream(2 * _ROWS_AHEAD))
        self.create_subscription(ReconstructionState, "reconstruction/state", self._on_state, 10)
        self._begin = self.create_client(BeginScan, "reconstruction/begin_scan")
        self._end = self.create_client(EndScan, "reconstruction/end_scan")
        self._until_ns = 0
        self._lost = 0
        self._calibration = ""
        self._advanced_s = time.monotonic()
        self._zero_ns = 0
        self._next_row = 0
        self._scan_id = ""
        self._laser_state: LaserState | None = None
        # A repeated state must not follow the next one.
        self._laser_lock = threading.Lock()
        self._failure: EschortyError | None = None
        steady_timer(self, 0.05, self._watch)
        steady_timer(self, _STATE_S, self._repeat_laser)
        self._player.start()

    def safe_state(self) -> None:
        """Stop a replay under way and end its scan."""
        if self._played.is_set():
            return
        if self._failure is None:
            self.get_logger().warning("interrupted; its scan ends with the points so far")
        self._closing.set()
        self._player.join(timeout=5.0)
        if self._scan_id:
            self._end.call_async(EndScan.Request(scan_id=self._scan_id))

    def destroy_node(self) -> None:
        """Stop the player, then the node."""
        self._closing.set()
        if self._player.is_alive():
            self._player.join(timeout=5.0)
        super().destroy_node()

    def _watch(self) -> None:
        if self._failure is not None:
            raise self._failure
        if not self._player.is_alive():
            rclpy.shutdown(context=self.context)

    def _repeat_laser(self) -> None:
        with self._laser_lock, unless_shut_down(self):
            if self._laser_state is not None:
                self._laser_state.header.stamp = self.get_clock().now().to_msg()
                self._laser.publish(self._laser_state)

    def _on_state(self, message: ReconstructionState) -> None:
        until_ns = ns_from_stamp(message.processed_until)
        if until_ns != self._until_ns:
            self._until_ns, self._advanced_s = until_ns, time.monotonic()
        self._lost, self._calibration = message.packets_lost, message.calibration

    # The player's thread.

    def _run(self) -> None:
        try:
            self._play()
            self._played.set()
        except EschortyError as error:
            self._failure = error
        except Exception:
            if self.context.ok() and not self._closing.is_set():
                self._failure = DeviceError(traceback.format_exc())

    def _play(self) -> None:
        self._wait(
            lambda: self.get_clock().now().nanoseconds > 0,
            "use_sim_time is true and /clock gives no time",
        )
        self._await_reconstruction()
        usual = Settings()
        recorded = self._recording.settings.items()
        if unusual := [f"{k} {v}" for k, v in recorded if v != getattr(usual, k, v)]:
            self.get_logger().info(
                f"recorded with {', '.join(unusual)}; for the same points the reconstruction needs "
                "these parameters, which replay.launch.py sets"
            )
        name = Path(self.parameters["recording"]).resolve().name
        scan, position_mm = self._recording.scan, self._recording.stage_samples["position_mm"]
        start_mm, stop_mm = float(position_mm.min()), float(position_mm.max())
        if scan is not None:
            start_mm, stop_mm = scan.start_mm, scan.stop_mm
        marks = self._recording.marks
        packets = timed_packets(self._reader, marks)
        first = next(packets, None)
        begin_us = int(self._recording.stage_samples["t_us"][0])
        if first is not None:
            begin_us = min(begin_us, first.from_us)
        self._zero_ns = int(self.get_clock().now().nanoseconds) - begin_us * NS_PER_US
        self._publish_clock()
        self._publish_laser(begin_us, on=not marks["laser_on"].any())
        # A scan of the same id would be the one that another replay has left open.
        self._scan_id = f"replay-{name}-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}"
        self._call(
            self._begin,
            BeginScan.Request(
                scan_id=self._scan_id,
                start=m_from_mm(start_mm),
                stop=m_from_mm(stop_mm),
                passes=1 if scan is None else scan.passes,
                speed=m_from_mm(abs(stage_speed_mm_s(self._recording))),
            ),
            again=True,
        )
        lost_before = self._lost + int(marks["packets_lost"].sum())
        last_us = None if first is None else self._publish_stream(chain([first], packets))
        self._publish_rows(np.iinfo(np.int64).max)
        if last_us is not None:
            self._await_processed(last_us)
        for warning in self._reader.warnings:
            self.get_logger().warning(warning)
        end, self._scan_id = EndScan.Request(scan_id=self._scan_id), ""
        answer = self._call(self._end, end)
        if not answer.points:
            raise DeviceError(answer.message)
        self.get_logger().info(
            f"{answer.points} points in {answer.profiles} profiles; {answer.message or 'no loss'}"
        )
        if self._lost != lost_before:
            raise DeviceError(
                f"{self._lost - lost_before} packets were lost; start the reconstruction with "
                f"{self._reliable()}"
            )

    def _await_reconstruction(self) -> None:
        publishers = (self._events, self._clock_reference, self._laser, self._odom)
        self._advanced_s = time.monotonic()
        self._wait(
            lambda: bool(
                all(publisher.get_subscription_count() for publisher in publishers)
                and self._begin.service_is_ready()
                and self._end.service_is_ready()
                and self._calibration
            ),
            "no reconstruction subscribes",
        )
        for end in self.get_subscriptions_info_by_topic(self._events.topic_name):
            if end.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT:
                name = "a node" if end.node_name.startswith("_") else end.node_name
                self.get_logger().warning(
                    f"{name} subscribes to {self._events.topic_name} best effort and may lose "
                    f"packets; start it with {self._reliable()}"
                )
        if self._calibration != (recorded := self._recording.calibration.name):
            self.get_logger().warning(
                f"the recording is of {recorded} and reconstructed with {self._calibration}; check "
                "that this is its instrument"
            )

    def _reliable(self) -> str:
        """Return the parameter that makes a node's subscription of the events reliable."""
        return f"qos_overrides.{self._events.topic_name}.subscription.reliability:=reliable"

    def _publish_clock(self) -> None:
        reference = TimeReference(source="recording")
        reference.header.stamp = stamp_from_ns(self._zero_ns)
        self._clock_reference.publish(reference)

    def _publish_laser(self, t_us: int, on: bool) -> None:
        modulation, stamp = self._recording.modulation, stamp_from_ns(self._ns(t_us))
        output = LaserState.OUTPUT_ON if on else LaserState.OUTPUT_OFF
        state = LaserState(
            requested=output,
            output=output,
            waveform=modulation.waveform,
            frequency=modulation.frequency_hz,
            duty=modulation.duty,
            output_since=stamp,
            reason="replay of a recording",
        )
        state.header.stamp = stamp
        if modulation.on_edge_us is not None:
            state.phase_epoch = stamp_from_ns(self._ns(modulation.on_edge_us))
        with self._laser_lock:
            self._laser_state = state
            self._laser.publish(state)

    def _publish_stream(self, packets: Iterable[TimedPacket]) -> int:
        """Publish all packets and the stage rows up to each; return the last sensor time (us)."""
        rate = self.parameters["rate"]
        rows_us = self._recording.stage_samples["t_us"]
        width, height = self._reader.header.named_size
        pending: list[int] = []
        began_s = time.monotonic()
        first_us: int | None = None
        until_us = seq = 0
        for packet in packets:
            first_us = packet.from_us if first_us is None else first_us
            until_us = packet.until_us
            self._pace(began_s, (until_us - first_us) * 1e-6, rate)
            self._publish_rows(until_us)
            if packet.laser_on:
                self._publish_laser(packet.from_us, on=True)
            seq += packet.packets_lost
            message = EventPacket(height=height, width=width, seq=seq, encoding="evt3")
            message.events.frombytes(packet.data)
            message.header.stamp = stamp_from_ns(self._ns(packet.from_us))
            message.header.frame_id = self._frames.optical
            self._events.publish(message)
            seq += 1
            pending.append(until_us)
            ahead = pending[-_PACKETS_AHEAD] if len(pending) >= _PACKETS_AHEAD else None
            row = self._next_row - _ROWS_AHEAD
            if row >= 0:
                ahead = max(min(int(rows_us[row]), until_us), ahead if ahead is not None else 0)
            if ahead is not None:
                self._await_processed(ahead)
        return until_us

    def _pace(self, began_s: float, elapsed_s: float, rate: float) -> None:
        wait_s = began_s + elapsed_s / rate - time.monotonic() if rate > 0.0 else 0.0
        if self._closing.wait(max(wait_s, 0.0)):
            raise DeviceError("interrupted")

    def _publish_rows(self, until_us: int) -> None:
        """Publish the stage rows up to the first one at or after ``until_us``."""
        rows = self._recording.stage_samples
        while self._next_row < len(rows):
            t_us = int(rows["t_us"][self._next_row])
            position_mm = float(rows["position_mm"][self._next_row])
            self._odom.publish(odometry(self._frames, self._ns(t_us), position_mm))
            self._next_row += 1
            if t_us >= until_us:
                break

    def _await_processed(self, t_us: int) -> None:
        self._advanced_s = time.monotonic()
        self._wait(lambda: self._until_ns >= self._ns(t_us), "the reconstruction makes no progress")

    def _ns(self, t_us: int) -> int:
        return self._zero_ns + t_us * NS_PER_US

    def _wait(self, condition: Callable[[], bool], fault: str) -> None:
        timeout_s, silent_s = self.parameters["timeout"], _SILENT_S
        while not condition():
            if self._closing.wait(_POLL_S) or not self.context.ok():
                raise DeviceError("interrupted")
            waited_s = time.monotonic() - self._advanced_s
            if waited_s > silent_s:
                silent_s = math.inf
                self.get_logger().info(f"{fault} yet; waits for {timeout_s:g} s at most")
            if waited_s > timeout_s:
                raise DeviceError(f"{fault} for {timeout_s:g} s; check that it runs")

    def _call(self, client: Any, request: Any, *, again: bool = False) -> Any:
        """Return a service's answer; see ``RepeatedCall``."""
        self._advanced_s = time.monotonic()
        call = RepeatedCall(client, request, again=again)
        self._wait(call.done, f"no answer of {client.srv_name}")
        answer = call.result()
        if not answer.success:
            raise DeviceError(f"reconstruction: {answer.message}")
        return answer


def main() -> int:
    """Play the recording; return 130 after a signal before its end."""
    played = threading.Event()
    return run(partial(ReplayNode, played)) or (0 if played.is_set() else _INTERRUPTED)


if __name__ == "__main__":
    sys.exit(main())
