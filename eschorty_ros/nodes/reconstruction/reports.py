"""The reconstruction's state and diagnostics."""

from __future__ import annotations

import math
import time
from typing import Any

from rclpy.node import Node

from eschorty_ros.control.stamp_ages import StampAges
from eschorty_ros.live.job_queue import JobQueue
from eschorty_ros.live.packet_stream import clock_statistics
from eschorty_ros.live.pipeline import Pipeline
from eschorty_ros.msg import ReconstructionState
from eschorty_ros.nodes.ros import diagnostics
from eschorty_ros.nodes.ros.border import saturated
from eschorty_ros.nodes.ros.conversions import stamp_from_ns

PACKETS_EXPECTED_S = 5.0
"""Time without packets, since the node's start or the last one, after which that is a warning."""
_REMINDER_S = 30.0


class Reports:
    """State and diagnostics of a pipeline that another thread runs; numbers may differ in time.

    Public attributes:
    - ``faults``: Unexpected exceptions of the worker, counted by the worker.
    - ``packet_ages``: Ages of the packets on arrival.
    """

    def __init__(self, node: Node, pipeline: Pipeline, jobs: JobQueue) -> None:
        self.faults = 0
        self.packet_ages = StampAges("camera")
        self._packets, self._arrived_s = 0, time.monotonic()
        self._node = node
        self._pipeline = pipeline
        self._jobs = jobs
        self._state = node.create_publisher(ReconstructionState, "reconstruction/state", 10)
        self._rate = diagnostics.Rate()
        self._diagnostics_rate = diagnostics.Rate()
        self._lost_reported = 0, 0

    def publish_state(self) -> None:
        """Publish ``reconstruction/state``."""
        pipeline = self._pipeline
        counters = pipeline.stream.counters
        until_ns = pipeline.stream.processed_until_ns
        state = ReconstructionState()
        state.header.stamp = self._node.get_clock().now().to_msg()
        if until_ns is not None:
            state.processed_until = stamp_from_ns(until_ns)
        state.events = saturated(counters["events"])
        state.events_per_second = self._rate.read(counters["events"])
        state.profiles = saturated(pipeline.profiles)
        state.points = saturated(pipeline.points)
        state.packets_lost = saturated(pipeline.stream.packets_lost)
        state.events_dropped = saturated(counters["events_over_column_limit"])
        state.sensor_drop_words = saturated(counters["sensor_drop_words"])
        state.points_without_stage = saturated(pipeline.placer.points_without_stage)
        state.scan_id = pipeline.scan_id
        age_s = self.packet_ages.least_s()
        state.packet_age = math.nan if age_s is None else age_s
        state.calibration = pipeline.calibration.name
        self._state.publish(state)

    def diagnose(self) -> diagnostics.Report:
        """Return level, line and values for ``/diagnostics``."""
        stream, placer = self._pipeline.stream, self._pipeline.placer
        counters = stream.counters
        values: dict[str, Any] = {
            "packets": stream.packets,
            "packets_lost": stream.packets_lost,
            "packets_late": stream.packets_late,
            "packets_refused_queue_full": self._jobs.overflows,
            "packets_held": stream.held,
            "stream_restarts": stream.restarts,
            "queue": len(self._jobs),
            "events_per_second": self._diagnostics_rate.read(counters["events"]),
            **clock_statistics(stream),
            "profiles": self._pipeline.profiles,
            "points": self._pipeline.points,
            "points_waiting_for_stage": placer.waiting,
            "points_without_stage": placer.points_without_stage,
            "stage_samples_late": placer.late_samples,
            "stage_restarts": placer.track_restarts,
            "faults": self.faults,
            **{f"reconstructor_{name}": count for name, count in sorted(counters.items())},
        }
        if self.faults:
            return diagnostics.ERROR, "internal errors; see the log", values
        # Read once: meanwhile the worker may take the packets.
        if waits_for := stream.waits_for if stream.held else "":
            return diagnostics.WARN, f"packets wait for the {waits_for}", values
        silent_s = self._silent_s()
        if stream.packets and silent_s > PACKETS_EXPECTED_S:
            return diagnostics.WARN, f"no packets for {silent_s:.0f} s; check the camera", values
        if stream.epoch is not None and stream.epoch.edges_missing:
            return diagnostics.WARN, "no edges of the stage; check its wire to the camera", values
        if warnings := [*self._new_losses(), *stream.warnings]:
            return diagnostics.WARN, "; ".join(warnings), values
        if not stream.packets:
            late = silent_s > PACKETS_EXPECTED_S
            if late:
                topic = self._node.resolve_topic_name("camera/events")
                self._node.get_logger().warning(
                    f"no packets on {topic} yet; check the camera's node, the topic and its QoS",
                    throttle_duration_sec=_REMINDER_S,
                )
            return diagnostics.WARN if late else diagnostics.OK, "no packets yet", values
        return diagnostics.OK, "reconstructing", values

    def _silent_s(self) -> float:
        """Return the time without packets as far as the calls of ``diagnose`` show it."""
        now_s, packets = time.monotonic(), self._pipeline.stream.packets
        if packets != self._packets:
            self._packets, self._arrived_s = packets, now_s
        return now_s - self._arrived_s

    def _new_losses(self) -> list[str]:
        """Return a line for each loss since the last call; log that of points."""
        placer = self._pipeline.placer
        lost = self._pipeline.stream.packets_lost, placer.points_without_stage
        before, self._lost_reported = self._lost_reported, lost
        lines = [
            f"{now - then:,} {what} since the last report, {now:,} so far"
            for now, then, what in zip(
                lost, before, ("packets lost", "points without stage position"), strict=True
            )
            if now > then
        ]
        if lost[1] > before[1]:
            lines[-1] += f"; {placer.newest_sample}"
            self._node.get_logger().warning(lines[-1], throttle_duration_sec=_REMINDER_S)
        return lines
