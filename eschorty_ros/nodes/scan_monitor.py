"""What the scanner hears from laser, stage and reconstruction, and who is to blame for silence."""

from __future__ import annotations

import time
from collections import deque

from nav_msgs.msg import Odometry
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from eschorty_ros.msg import LaserState, ReconstructionState
from eschorty_ros.nodes import qos
from eschorty_ros.nodes.conversions import mm_from_m, ns_from_stamp
from eschorty_ros.nodes.scan_sequence import ScanFailure

# With Fast DDS's defaults what got lost comes again after 3 s.
_STALE_S = 4.0
_REST_M_S = 1e-4
_SAMPLES_MAX = 500_000


class ScanMonitor:
    """Newest state of the other nodes, on the steady clock.

    Attributes
    ----------
    samples : deque of (int, float)
        ROS time (ns) and stage position (mm), cleared by whoever wants a fresh record.
    """

    def __init__(self, node: Node, group: CallbackGroup) -> None:
        self._node = node
        self.samples: deque[tuple[int, float]] = deque(maxlen=_SAMPLES_MAX)
        self.laser: LaserState | None = None
        self.reconstruction: ReconstructionState | None = None
        self.position_mm = float("nan")
        self.at_rest = False
        self.until_ns = 0
        self._laser_s = self._reconstruction_s = self._stage_s = self._advanced_s = 0.0
        node.create_subscription(
            LaserState,
            "laser/state",
            self._on_laser,
            qos.latched(qos.STATE_HISTORY),
            callback_group=group,
        )
        node.create_subscription(
            ReconstructionState,
            "reconstruction/state",
            self._on_reconstruction,
            10,
            callback_group=group,
        )
        node.create_subscription(
            Odometry, "stage/odom", self._on_stage, qos.stream(), callback_group=group
        )

    @property
    def output(self) -> int | None:
        """Output the laser reads back, ``None`` before its first state."""
        return self.laser.output if self.laser is not None else None

    @property
    def stage_heard(self) -> bool:
        """Whether odometry is fresh."""
        return _age_s(self._stage_s) < _STALE_S

    def restart_patience(self) -> None:
        """Count the reconstruction's standstill from now."""
        self._advanced_s = time.monotonic()

    def check_stage(self) -> None:
        """Raise ``ScanFailure`` when odometry stopped."""
        if not self.stage_heard:
            raise ScanFailure(f"stage: no odometry for {_STALE_S:g} s")

    def check_progress(self, timeout_s: float) -> None:
        """Raise ``ScanFailure`` when the reconstruction has stood still for ``timeout_s``."""
        if _age_s(self._advanced_s) > timeout_s:
            raise ScanFailure(f"{self.why_no_progress()} for {timeout_s:g} s")

    def check_laser(self) -> None:
        """Raise ``ScanFailure`` when the laser is silent or not on."""
        if self.laser is None or _age_s(self._laser_s) > _STALE_S:
            raise ScanFailure(f"laser: no state for {_STALE_S:g} s")
        if self.laser.output != LaserState.OUTPUT_ON:
            raise ScanFailure(f"laser: went off: {self.laser.reason}")

    def why_no_progress(self) -> str:
        """Name the node that keeps the reconstruction from advancing."""
        if _age_s(self._reconstruction_s) > _STALE_S:
            return "reconstruction: it does not report"
        if self._node.count_publishers(self._node.resolve_topic_name("camera/events")) == 0:
            return "camera: its node is gone; no events"
        return "camera: no events reach the reconstruction"

    def _on_laser(self, message: LaserState) -> None:
        self.laser, self._laser_s = message, time.monotonic()

    def _on_reconstruction(self, message: ReconstructionState) -> None:
        now_s = time.monotonic()
        until_ns = ns_from_stamp(message.processed_until)
        if until_ns != self.until_ns:
            self.until_ns, self._advanced_s = until_ns, now_s
        self.reconstruction, self._reconstruction_s = message, now_s

    def _on_stage(self, message: Odometry) -> None:
        self.position_mm = mm_from_m(message.pose.pose.position.y)
        self._stage_s = time.monotonic()
        self.at_rest = abs(message.twist.twist.linear.y) < _REST_M_S
        self.samples.append((ns_from_stamp(message.header.stamp), self.position_mm))


def _age_s(at_s: float) -> float:
    return time.monotonic() - at_s
