"""The stage node with the topic ``test/break``, after which its driver fails in an unknown way."""

import sys
from typing import Any

from std_msgs.msg import Empty

from eschorty_ros.hardware.base.protocols import StageState
from eschorty_ros.hardware.stage.apt_stage import AptStage
from eschorty_ros.nodes.ros.spin import run
from eschorty_ros.nodes.stage.node import StageNode


class BreakableStage(StageNode):
    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.create_subscription(Empty, "test/break", self._on_break, 10)

    def _on_break(self, message: Empty) -> None:
        def broken(stage: AptStage, t_ns: int | None = None) -> StageState:
            raise ValueError("no number")

        AptStage.state = broken


if __name__ == "__main__":
    sys.exit(run(BreakableStage, threads=4))
