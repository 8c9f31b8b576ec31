"""One calibration at the start of the node, for the launch file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from eschorty_ros.action import Calibrate
from eschorty_ros.core.calibration import read_distances
from eschorty_ros.core.optics import config_file
from eschorty_ros.nodes.reconstruction.calibration_messages import target_message
from eschorty_ros.nodes.ros.steady_timer import steady_timer


class AutoCalibration:
    """Sends one goal to the ``calibrate`` action as soon as its server is discovered.

    - ``distances``: File of the known targets: a name in ``config/`` or a path.

    Raises ``FormatError`` or ``CalibrationError`` when the file cannot be read or is not found.
    """

    def __init__(self, node: Node, distances: str, method: str, capture_s: float) -> None:
        targets = [target_message(target) for target in read_distances(find_distances(distances))]
        self._goal = Calibrate.Goal(targets=targets, method=method, capture_time=capture_s)
        group = ReentrantCallbackGroup()
        self._client: ActionClient[Any, Any, Any] = ActionClient(
            node, Calibrate, "calibrate", callback_group=group
        )
        self._timer = steady_timer(node, 0.1, self._send, group)

    def _send(self) -> None:
        if self._client.server_is_ready():
            self._timer.cancel()
            self._client.send_goal_async(self._goal)


def find_distances(name_or_path: str) -> Path:
    """Return the path of a file of known targets: a name in ``config/`` or a path."""
    bare = os.sep not in name_or_path and "." not in name_or_path
    return config_file(f"{name_or_path}.csv") if bare else Path(name_or_path)
