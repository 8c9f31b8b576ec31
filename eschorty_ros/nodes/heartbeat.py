"""Sign of life of a node whose failure must darken the laser."""

from __future__ import annotations

import threading
from collections.abc import Callable

from rclpy.node import Node
from std_msgs.msg import Header

from eschorty_ros.nodes import qos

PERIOD_S = 0.03


class Heartbeat:
    """Publishes a ``std_msgs/Header`` every 30 ms for as long as ``healthy()`` is true.

    In a thread of its own, so that a busy executor does not look like a dead device; it ends with
    the node's context. The laser goes dark when the beats stop (see ``nodes/laser.py``).

    Parameters
    ----------
    node : rclpy.node.Node
    topic : str
        ``camera/heartbeat`` or the like.
    healthy : callable
        Whether the device does what it should, right now; called in the thread, must not wait.
    """

    def __init__(self, node: Node, topic: str, healthy: Callable[[], bool]) -> None:
        self._node = node
        self._healthy = healthy
        self._publisher = node.create_publisher(Header, topic, qos.heartbeat())
        threading.Thread(target=self._beat, name=topic, daemon=True).start()

    def _beat(self) -> None:
        pause = threading.Event()
        while not pause.wait(PERIOD_S) and self._node.context.ok():
            if not self._healthy():
                continue
            message = Header(stamp=self._node.get_clock().now().to_msg())
            try:
                self._publisher.publish(message)
            except Exception:
                # A signal may end the context, or the node be destroyed, in between.
                return
