"""Names of the instrument's frames."""

from __future__ import annotations

from typing import NamedTuple

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.nodes.ros.parameters import Param

FRAME_PREFIX = Param(
    "frame_prefix",
    "eschorty_",
    "begins the frames' names: base, stage, link, optical; one for each instrument",
)


class Frames(NamedTuple):
    """Names of the frames."""

    base: str
    stage: str
    link: str
    optical: str


def frames(prefix: str) -> Frames:
    """Return the frames' names with a prefix.

    Raises ``ArgumentError`` for one that begins with a slash: tf2 takes no such name.
    """
    if prefix.startswith("/"):
        raise ArgumentError(f"frame_prefix is {prefix!r}; tf2 takes no slash at the beginning")
    return Frames(*(prefix + name for name in Frames._fields))
