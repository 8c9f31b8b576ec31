"""Frames of the instrument: base -> stage carriage -> link -> optical."""

from __future__ import annotations

import math

from geometry_msgs.msg import TransformStamped

from eschorty_ros.core.reconstruction import stage_offset_m
from eschorty_ros.nodes.ros.conversions import stamp_from_ns
from eschorty_ros.nodes.ros.frames import Frames


def carriage(
    names: Frames, t_ns: int, position_mm: float, direction: tuple[float, float, float]
) -> TransformStamped:
    """Return the carriage in the base at ROS time ``t_ns``; ``direction`` is a unit vector."""
    transform = _between(names.base, names.stage, t_ns)
    offset_m = transform.transform.translation
    offset_m.x, offset_m.y, offset_m.z = stage_offset_m(position_mm, direction).tolist()
    return transform


def mounts(names: Frames, t_ns: int) -> list[TransformStamped]:
    """Return the static transforms: carriage to link (same axes), link to optical (z forward).

    The optical frame has the link's origin and other axes: x right along increasing columns, y
    down, z along the range axis.
    """
    optical = _between(names.link, names.optical, t_ns)
    optical.transform.rotation.x = optical.transform.rotation.z = math.sqrt(0.5)
    optical.transform.rotation.w = 0.0
    return [_between(names.stage, names.link, t_ns), optical]


def _between(parent: str, child: str, t_ns: int) -> TransformStamped:
    transform = TransformStamped()
    transform.header.stamp = stamp_from_ns(t_ns)
    transform.header.frame_id = parent
    transform.child_frame_id = child
    transform.transform.rotation.w = 1.0
    return transform
