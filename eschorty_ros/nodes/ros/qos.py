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
    """Return the profile of raw event packets: best effort, deep, as metavision_driver's."""
    return _profile(EVENT_DEPTH, ReliabilityPolicy.BEST_EFFORT)


def latched(depth: int = 1) -> QoSProfile:
    """Return the profile of a state that a late joiner still receives: reliable, transient local.

    ``depth`` is 1 where only the newest message counts, ``STATE_HISTORY`` where no change may be
    lost, such as the laser's state.
    """
    return _profile(depth, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)


def stream(depth: int = STREAM_DEPTH) -> QoSProfile:
    """Return the profile of messages that must reach all subscribers: reliable, volatile."""
    return _profile(depth, ReliabilityPolicy.RELIABLE)


def heartbeat() -> QoSProfile:
    """Return the profile of heartbeats: only the newest counts, and none is repeated."""
    return _profile(1, ReliabilityPolicy.BEST_EFFORT)


def overridable() -> QoSOverridingOptions:
    """Return the options that ``qos_overrides.<topic>...`` can set: history, depth, reliability."""
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
