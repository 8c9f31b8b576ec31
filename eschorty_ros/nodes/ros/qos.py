"""Quality of service, one function per kind of topic.

Every call returns a new profile, because overriding by parameter changes the profile.
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
    """State that a late joiner still receives: reliable, transient local.

    ``depth`` is 1 where only the newest message counts, ``STATE_HISTORY`` where no change may be
    lost, such as the laser's state.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def stream(depth: int = STREAM_DEPTH) -> QoSProfile:
    """Messages that must all reach the present subscribers: reliable, volatile."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


def heartbeat() -> QoSProfile:
    """Heartbeats: only the newest counts, and none is repeated."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def overridable() -> QoSOverridingOptions:
    """History, depth and reliability settable by the parameters ``qos_overrides.<topic>...``."""
    return QoSOverridingOptions.with_default_policies()
