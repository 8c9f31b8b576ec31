"""The health of a node on ``/diagnostics``, once a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from eschorty_ros.nodes.ros.border import refusals
from eschorty_ros.nodes.ros.steady_timer import steady_timer

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR

NO_CLOCK = "use_sim_time is true and nothing is on /clock; leave it out with real devices"

Report = tuple[bytes, str, Mapping[str, Any]]


class Rate:
    """Increase per second of a total between two readings, on the steady clock."""

    def __init__(self) -> None:
        self._total = 0.0
        self._read_at_s = time.monotonic()

    def read(self, total: float) -> float:
        """Return the rate since the last reading from the present ``total``."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._read_at_s
        rate = (total - self._total) / elapsed_s if elapsed_s > 0.0 else 0.0
        self._total, self._read_at_s = total, now_s
        return max(rate, 0.0)


class Diagnostics:
    """Publishes the result of ``report`` in every lifecycle state.

    - ``report``: Returns level (``OK``, ``WARN``, ``ERROR``), one line, and named values with their
      units in the names. A node whose ``waiting`` is not empty is at ``WARN`` with that line.
    - ``callback_group``: Group of the timer; the node's default group when omitted.
    """

    def __init__(
        self,
        node: Node,
        report: Callable[[], Report],
        callback_group: CallbackGroup | None = None,
    ) -> None:
        self._node = node
        self._report = report
        self._refused = 0
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady_timer(node, 1.0, self.publish, callback_group)

    def publish(self) -> None:
        """Publish now; also called every second."""
        level, message, values = self._report()
        refused = refusals(self._node)
        total = refused.counts.total()
        if fresh := total - self._refused:
            level = max(level, WARN)
            message += (
                f"; {fresh} messages were refused in the last second, the last of {refused.last}"
            )
        self._refused = total
        now = self._node.get_clock().now()
        if not now.nanoseconds and NO_CLOCK not in message:
            level, message = max(level, WARN), f"{message}; {NO_CLOCK}"
        values = {**values, **refused.values()}
        waiting = getattr(self._node, "waiting", "")
        if waiting:
            level, message = WARN, waiting
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=message,
            hardware_id=str(values.get("device", "")),
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = now.to_msg()
        self._publisher.publish(array)


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
