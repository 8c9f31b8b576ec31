"""Heartbeat of a node whose failure must disable the laser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from std_msgs.msg import Header

from eschorty_ros.control.heartbeat import CHECK_S, HeartbeatSchedule
from eschorty_ros.hardware.base.stalls import StallMeter
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.spin import ends

_LOG_S = 1.0


class Heartbeat:
    """Publishes a ``std_msgs/Header`` every 0.1 s for as long as ``healthy()`` is true.

    The header's ``frame_id`` identifies the process (see ``control.heartbeat``), so that a laser
    node on the same host detects its end. It runs in a thread of its own, because a busy executor
    is no failure of the device; it ends with the node's context.

    - ``topic``: ``camera/heartbeat`` or the like.
    - ``healthy``: Returns whether the device works now; called in the thread, must not wait.
    - ``wanted``: Returns whether a heartbeat may come; ``begin`` starts the thread, which ends when
      none may and the last one has been sent. When omitted it begins at once.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        healthy: Callable[[], bool],
        wanted: Callable[[], bool] | None = None,
    ) -> None:
        self._node, self._topic = node, topic
        self._wanted = wanted or (lambda: True)
        self._lock = threading.Lock()
        self._runs = False
        self._healthy = healthy
        self._schedule = HeartbeatSchedule()
        self._publisher = node.create_publisher(Header, topic, qos.heartbeat())
        if wanted is None:
            self.begin()

    @property
    def healthy(self) -> bool:
        """Return whether the last heartbeat reported a healthy device."""
        return self._schedule.healthy

    def begin(self) -> None:
        """Start the thread unless it runs; what ``wanted`` returns must have changed before."""
        with self._lock:
            if not self._runs:
                self._runs = True
                threading.Thread(target=self._run, name=self._topic, daemon=True).start()

    def _ends(self) -> bool:
        with self._lock:
            self._runs = self._schedule.left > 0 or self._wanted()
            return not self._runs

    def _run(self) -> None:
        stalls = StallMeter()
        while not self._ends():
            time.sleep(CHECK_S)
            if not self._node.context.ok():
                return
            healthy, now_s = self._checked_health(), time.monotonic()
            text = self._schedule.check(healthy, stalls.measure(CHECK_S), now_s)
            if text is not None and not self._publish(text):
                with self._lock:
                    self._runs = False
                return

    def _checked_health(self) -> bool:
        try:
            return self._healthy()
        except Exception as error:
            self._node.get_logger().error(f"health not known: {error!r}", once=True)
            return False

    def _publish(self, text: str) -> bool:
        """Publish, log a failure; return whether the node still exists."""
        try:
            stamp = self._node.get_clock().now().to_msg()
            self._publisher.publish(Header(stamp=stamp, frame_id=text))
        except _rclpy.InvalidHandle:
            return False
        except Exception as error:
            # A signal may end the context in between.
            if not ends(self._node):
                self._node.get_logger().error(
                    f"{self._topic} not sent: {error!r}", throttle_duration_sec=_LOG_S
                )
        return True
