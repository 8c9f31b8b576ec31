"""The laser node with the topic ``test/break``, which makes it fail."""

import ctypes
import os
import sys
from typing import Any

from std_msgs.msg import String

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.nodes.laser.node import THREADS, LaserNode
from eschorty_ros.nodes.ros.spin import run


class BreakableLaser(LaserNode):
    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.create_subscription(String, "test/break", self._on_break, 10)

    def _on_break(self, message: String) -> None:
        if message.data == "exception":
            self.create_timer(1e-3, self._fail)
        if message.data == "abort":
            os.abort()
        if message.data == "segfault":
            ctypes.string_at(0)

    def _fail(self) -> None:
        raise DeviceError("a timer that fails")


if __name__ == "__main__":
    sys.exit(run(BreakableLaser, threads=THREADS))
