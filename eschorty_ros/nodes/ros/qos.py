"""Quality of service, one function per kind of topic; every call returns a fresh profile.

Fresh, because overriding by parameter changes the profile it is given.
"""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

EVENT_DEPTH = 1000
STREAM_DEPTH = 200
STATE_HISTORY = 100


def events() -> QoSProfile:
    """Raw event packets: best effort, deep queue, as metavision_driver publishes them."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=EVENT_DEPTH,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def latched(depth: int = 1) -> QoSProfile:
    """State a late joiner must still get: reliable, transient local.

    ``depth`` is 1 for what is simply replaced; ``STATE_HISTORY`` where no change may be lost on
    the way, such as the laser's state.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def stream(depth: int = STREAM_DEPTH) -> QoSProfile:
    """Messages that must all arrive while one listens: reliable, volatile."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


def heartbeat() -> QoSProfile:
    """Signs of life: only the newest counts, and none is worth repeating."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def overridable() -> QoSOverridingOptions:
    """History, depth and reliability settable by the parameters ``qos_overrides.<topic>...``."""
    return QoSOverridingOptions.with_default_policies()
