"""Timers on the steady clock, which is never set and no replay stops."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.timer import Timer


def steady_timer(
    node: Node,
    period_s: float,
    callback: Callable[[], Any],
    group: CallbackGroup | None = None,
    *,
    autostart: bool = True,
) -> Timer:
    """Return a timer of ``node`` on a steady clock."""
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    return node.create_timer(period_s, callback, group, clock, autostart)
