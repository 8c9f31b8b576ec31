"""Stand-in for a scanner, a camera or a stage: it only beats, until SIGUSR1 makes it ill."""

from __future__ import annotations

import signal
import sys

from rclpy.node import Node

from eschorty_ros.nodes.ros.heartbeat import Heartbeat
from eschorty_ros.nodes.ros.spin import run


class Beating(Node):
    """Parameter ``topics``: what to beat on, with blanks between."""

    def __init__(self) -> None:
        super().__init__("beating")
        self._well = True
        signal.signal(signal.SIGUSR1, self._fall_ill)
        topics = self.declare_parameter("topics", "").value.split()
        self._heartbeats = [Heartbeat(self, topic, lambda: self._well) for topic in topics]

    def _fall_ill(self, *_: object) -> None:
        self._well = False


if __name__ == "__main__":
    sys.exit(run(Beating))
