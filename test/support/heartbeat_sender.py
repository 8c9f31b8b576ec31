"""Stand-in for a scanner, a camera or a stage; SIGUSR1 makes its heartbeats report a stop."""

import os
import signal
import sys

from rclpy.node import Node

from eschorty_ros.nodes.ros.heartbeat import Heartbeat
from eschorty_ros.nodes.ros.spin import run


class HeartbeatSender(Node):
    """Parameter ``topics``: heartbeat topics, with blanks between."""

    def __init__(self) -> None:
        # Several run side by side.
        super().__init__(f"heartbeat_sender_{os.getpid()}")
        self._healthy = True
        signal.signal(signal.SIGUSR1, self._fail)
        topics = self.declare_parameter("topics", "").value.split()
        self._heartbeats = [Heartbeat(self, topic, lambda: self._healthy) for topic in topics]

    def _fail(self, *_: object) -> None:
        self._healthy = False


if __name__ == "__main__":
    sys.exit(run(HeartbeatSender))
