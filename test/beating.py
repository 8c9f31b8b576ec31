"""Stand-in for a scanner, a camera or a stage: ``python -m beating TOPIC`` only beats."""

from __future__ import annotations

import sys

from rclpy.node import Node

from eschorty_ros.nodes.heartbeat import Heartbeat
from eschorty_ros.nodes.spin import run


class Beating(Node):
    def __init__(self) -> None:
        super().__init__("beating")
        topic = self.declare_parameter("topic", "").value
        self._heartbeat = Heartbeat(self, topic, lambda: True)


if __name__ == "__main__":
    sys.exit(run(Beating))
