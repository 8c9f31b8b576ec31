"""From events to targets: the names other parts of the package use."""

from __future__ import annotations

from eschorty_ros.core.calibration._post_lines import KnownTarget
from eschorty_ros.core.calibration.aggregate_frame import AggregateFrame
from eschorty_ros.core.calibration.moving_target import moving_target
from eschorty_ros.core.calibration.post_finder import Post, find_posts
from eschorty_ros.core.calibration.post_matching import PostMatch, match_posts

__all__ = [
    "AggregateFrame",
    "KnownTarget",
    "Post",
    "PostMatch",
    "find_posts",
    "match_posts",
    "moving_target",
]
