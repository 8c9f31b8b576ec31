"""The calibration in use: published, and exchanged only for one of the same instrument."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from eschorty_ros.core.base.errors import CalibrationError, EschortyError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.calibration import Targets, write_targets
from eschorty_ros.core.optics import (
    Calibration,
    load_calibration,
    load_named_calibration,
    refuse_other_instrument,
    save_calibration,
    save_named_calibration,
)
from eschorty_ros.msg import ActiveCalibration as ActiveCalibrationMessage
from eschorty_ros.nodes.reconstruction.calibration_messages import active_message
from eschorty_ros.nodes.reconstruction.parameters import expanded_folder
from eschorty_ros.nodes.ros import qos
from eschorty_ros.srv import LoadCalibration, SaveCalibration

Use = Callable[[Calibration], None]


class ActiveCalibration:
    """Holds the active calibration, publishes it latched, loads and saves it by service.

    - ``calibration``: The first one; every later one must have the same sensor and build.
    - ``file``: Its file.
    - ``folder``: Folder for calibrations; ``""``: ``eschorty`` in ROS's home.
    - ``paths``: Whether the services take paths, too: any file that the process may read or write.
    - ``use``: Changes the calibration in use, or raises an ``EschortyError`` and changes nothing.
    """

    def __init__(
        self,
        node: Node,
        calibration: Calibration,
        file: str,
        folder: str,
        paths: bool,
        use: Use,
    ) -> None:
        self.calibration = calibration
        self.folder = expanded_folder("calibration_folder", folder) if folder else _home()
        self._node = node
        self._paths = paths
        self._use = use
        # The one in use is the one published, also when a fit ends while another is loaded.
        self._exchanging = threading.Lock()
        self._publisher = node.create_publisher(
            ActiveCalibrationMessage, "reconstruction/calibration", qos.latched()
        )
        # One at a time, so that loading and writing do not mix.
        group = MutuallyExclusiveCallbackGroup()
        for kind, name, callback in (
            (LoadCalibration, "load_calibration", self._on_load),
            (SaveCalibration, "save_calibration", self._on_save),
        ):
            node.create_service(kind, f"reconstruction/{name}", callback, callback_group=group)
        self._publish(file)

    def store(self, calibration: Calibration, targets: Targets) -> str:
        """Write ``calibration`` and its targets, then use it; return the calibration's path.

        Raises ``EschortyError`` when it belongs to another instrument, cannot be written or cannot
        be used now; the active one then stays.
        """
        refuse_other_instrument(calibration, self.calibration)
        path = save_named_calibration(self.folder, calibration)
        write_targets(targets_path(path), targets)
        self._exchange(calibration, str(path))
        return str(path)

    def _exchange(self, calibration: Calibration, file: str) -> None:
        with self._exchanging:
            self._use(calibration)
            self.calibration = calibration
            self._publish(file)
        self._node.get_logger().info(f"calibration {calibration.label}: {file}")

    def _publish(self, file: str) -> None:
        now_ns = self._node.get_clock().now().nanoseconds
        self._publisher.publish(active_message(self.calibration, file, now_ns))

    def _on_load(self, request: Any, response: Any) -> Any:
        try:
            calibration = self._load(request.calibration)
            refuse_other_instrument(calibration, self.calibration)
            self._exchange(calibration, request.calibration)
        except EschortyError as error:
            response.message = str(error)
            return response
        response.success, response.id = True, calibration.id or ""
        return response

    def _on_save(self, request: Any, response: Any) -> Any:
        calibration = self.calibration
        try:
            path = self._save(calibration, request.path)
        except EschortyError as error:
            response.message = str(error)
            return response
        response.success, response.file = True, str(path)
        return response

    def _load(self, name: str) -> Calibration:
        if self._is_path(name):
            return load_calibration(name)
        return load_named_calibration(self.folder, name)

    def _save(self, calibration: Calibration, name: str) -> Path:
        if self._is_path(name):
            save_calibration(calibration, name)
            return Path(name)
        return save_named_calibration(self.folder, calibration, name)

    def _is_path(self, name: str) -> bool:
        """Return whether ``name`` is a path; CalibrationError where the services take none."""
        if os.sep in name and not self._paths:
            raise CalibrationError(
                f"{short(name)} is a path; give a name, or start the reconstruction with the "
                "parameter calibration_paths true"
            )
        return os.sep in name


def targets_path(calibration_path: Path) -> Path:
    """Return the path of the targets of a calibration fitted on the instrument."""
    return calibration_path.with_name(f"{calibration_path.stem}-targets.csv")


def _home() -> Path:
    return Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "eschorty"
