"""The camera's own region of interest, kept at the region that is reconstructed."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.reconstruction import SensorWindow, Settings, region_window
from eschorty_ros.nodes.ros.repeated_call import RepeatedCall
from eschorty_ros.nodes.ros.steady_timer import steady_timer

_PERIOD_S = 0.2


class CameraRoi:
    """Sets the parameter ``roi`` of the camera node, also of one that starts later.

    - ``follows``: Whether to do so.
    """

    def __init__(self, node: Node, follows: bool) -> None:
        self._node = node
        self._follows = follows
        group = MutuallyExclusiveCallbackGroup()
        self._client = node.create_client(
            SetParameters, "camera/set_parameters", callback_group=group
        )
        self._wanted: SensorWindow | None = None
        self._full: SensorWindow | None = None
        self._set: SensorWindow | None = None
        self._call: tuple[SensorWindow, RepeatedCall] | None = None
        if follows:
            steady_timer(node, _PERIOD_S, self._step, group)

    def follow(self, settings: Settings, model: Any) -> None:
        """Follow the region of ``settings`` with the calibration's range model."""
        self._wanted = region_window(settings, model)
        self._full = SensorWindow(0, 0, model.columns, model.rows)

    def check_full(self) -> None:
        """Raise ``ArgumentError`` where the camera sees a part of its sensor only."""
        if self._follows and self._wanted is not None and self._wanted != self._full:
            raise ArgumentError(
                f"camera_roi is 'follow' and leaves the window {tuple(self._wanted)} of the "
                "sensor; calibrate without limits of columns and ranges"
            )

    def _step(self) -> None:
        if not self._client.service_is_ready():
            self._set = self._call = None
            return
        if self._call is None and self._wanted is not None and self._wanted != self._set:
            roi = Parameter("roi", value=list(self._wanted)).to_parameter_msg()
            request = SetParameters.Request(parameters=[roi])
            self._call = self._wanted, RepeatedCall(self._client, request, again=True)
        if self._call is not None and self._call[1].done():
            (self._set, call), self._call = self._call, None
            result = call.result().results[0]
            if not result.successful:
                self._node.get_logger().warning(
                    f"camera_roi: the camera refuses roi {tuple(self._set)}: {result.reason}"
                )
