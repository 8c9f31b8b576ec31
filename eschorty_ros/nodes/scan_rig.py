"""The scan sequence's hands: laser, stage and the reconstruction's services."""

from __future__ import annotations

from rclpy.node import Node

from eschorty_ros.nodes.conversions import m_from_mm
from eschorty_ros.nodes.rig import LaserStageRig
from eschorty_ros.nodes.scan_sequence import ScanFailure, ScanRequest, ScanSummary
from eschorty_ros.srv import BeginScan, EndScan


class RosRig(LaserStageRig):
    """Implements ``scan_sequence.Rig``; arguments as those of ``LaserStageRig``."""

    def __init__(
        self,
        node: Node,
        node_timeout_s: float,
        service_timeout_s: float,
        events_timeout_s: float,
    ) -> None:
        services = {
            "reconstruction/begin_scan": BeginScan,
            "reconstruction/end_scan": EndScan,
        }
        super().__init__(node, node_timeout_s, service_timeout_s, events_timeout_s, services)

    def begin_scan(self, request: ScanRequest) -> None:
        """See ``Rig``. A scan that a scanner left behind is ended and published first."""
        state = self.monitor.reconstruction
        if state is not None and state.scan_id:
            self._node.get_logger().warning(f"ending {state.scan_id}, which nobody ended")
            self.end_scan(state.scan_id)
        begin = BeginScan.Request(
            scan_id=request.scan_id,
            start=m_from_mm(request.start_mm),
            stop=m_from_mm(request.stop_mm),
        )
        # Without its answer nobody would know that there is a scan to end.
        with self._uncanceled():
            answer = self._call("reconstruction/begin_scan", begin)
        if not answer.success:
            raise ScanFailure(f"reconstruction: {answer.message}")

    def end_scan(self, scan_id: str) -> ScanSummary:
        """See ``Rig``."""
        request = EndScan.Request(scan_id=scan_id)
        answer = self._call("reconstruction/end_scan", request, patience_s=60.0)
        if not answer.success:
            raise ScanFailure(f"reconstruction: {answer.message}")
        return ScanSummary(answer.profiles, answer.points, answer.events, answer.packets_lost,
                           answer.events_dropped, answer.sigma_median, answer.message)  # fmt: skip
