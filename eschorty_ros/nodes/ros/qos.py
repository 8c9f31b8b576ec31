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
    return _profile(EVENT_DEPTH, ReliabilityPolicy.BEST_EFFORT)


def latched(depth: int = 1) -> QoSProfile:
    """State that a late joiner still receives: reliable, transient local.

    ``depth`` is 1 where only the newest message counts, ``STATE_HISTORY`` where no change may be
    lost, such as the laser's state.
    """
    return _profile(depth, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)


def stream(depth: int = STREAM_DEPTH) -> QoSProfile:
    """Messages that must all reach the present subscribers: reliable, volatile."""
    return _profile(depth, ReliabilityPolicy.RELIABLE)


def heartbeat() -> QoSProfile:
    """Heartbeats: only the newest counts, and none is repeated."""
    return _profile(1, ReliabilityPolicy.BEST_EFFORT)


def overridable() -> QoSOverridingOptions:
    """History, depth and reliability settable by the parameters ``qos_overrides.<topic>...``."""
    return QoSOverridingOptions.with_default_policies()


def _profile(
    depth: int,
    reliability: ReliabilityPolicy,
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=reliability,
        durability=durability,
    )
