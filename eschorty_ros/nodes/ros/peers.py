"""The publishers of messages: their nodes' names, and topics that allow one publisher alone."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import ROSClock
from rclpy.node import Node
from rclpy.subscription import Subscription

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.steady_timer import steady_timer

_PUBLISHER_TIMEOUT_NS = 250_000_000
_CHECK_S = 1.0
# A stage at rest sends 5 times per second.
_PAUSE_S = 1.5
_NAMES_MAX = 64
_UNKNOWN = "_NODE_NAME_UNKNOWN_"


class OnePublisher:
    """Checks that a stream's messages come from one publisher until that pauses for 0.25 s."""

    def __init__(self) -> None:
        self._publisher = b""
        self._received_ns: float = -math.inf
        self._received_s = -math.inf

    def check(self, info: Mapping[str, Any]) -> bytes:
        """Return the publisher of the message with this information, ``b""`` where unknown.

        Raises ``ArgumentError`` when another publisher's stream goes on.
        """
        publisher, received_ns = _publisher(info), int(info["received_timestamp"])
        if (
            publisher != self._publisher
            and abs(received_ns - self._received_ns) < _PUBLISHER_TIMEOUT_NS
        ):
            raise ArgumentError("another node publishes it, too; stop all but one")
        self._publisher, self._received_ns = publisher, received_ns
        self._received_s = time.monotonic()
        return publisher

    def pause_fault(self, node: Node, topic: str) -> str:
        """Return that the publisher is there and sends nothing, ``""`` when it sends or has left.

        One that ended without leaving stays for 10 to 20 s, in which its successor may be unknown.
        """
        full, paused_s = node.resolve_topic_name(topic), time.monotonic() - self._received_s
        if paused_s < _PAUSE_S or self._publisher not in _present(node, full):
            return ""
        return f"nothing on {full} for {paused_s:.0f} s; look at its node, publish at rest, too"


class Publishers:
    """The publishers of one topic and the names of their nodes.

    rclpy before Kilted does not identify a message's publisher: it is ``""`` then, without a name.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._names: dict[bytes, str] = {}

    def id(self, info: Mapping[str, Any]) -> str:
        """Return the identity of a message's publisher as text."""
        return _publisher(info).hex()

    def present(self) -> set[str]:
        """Return the identities of those that are there."""
        return {publisher.hex() for publisher in _present(self._node, self._topic)}

    def name(self, info: Mapping[str, Any]) -> str:
        """Return the full name of the node that published a message, ``""`` while it is unknown."""
        publisher = _publisher(info)
        if publisher and publisher not in self._names:
            for end in self._node.get_publishers_info_by_topic(self._topic):
                if end.node_name == _UNKNOWN:
                    continue
                if len(self._names) >= _NAMES_MAX:
                    self._names.clear()
                name = f"{end.node_namespace.rstrip('/')}/{end.node_name}"
                self._names[bytes(end.endpoint_gid)] = name
        return self._names.get(publisher, "")


class LatchedState:
    """Receives a latched topic whose state ends with its publisher.

    The states of the publishers that are left are then received again.

    - ``take``: Receives each message.
    - ``ended``: Called when the publisher of the newest message has ended.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        topic: str,
        take: Callable[[Any], None],
        ended: Callable[[], None],
        group: CallbackGroup,
    ) -> None:
        self._node, self._kind, self._topic, self._group = node, kind, topic, group
        self._take, self._ended = take, ended
        self._publisher: bytes = b""
        self.subscription = self._subscribed()
        steady_timer(node, _CHECK_S, self.check, group)

    def check(self) -> None:
        """End the state if its publisher has ended."""
        if not self._publisher:
            return
        if self._publisher in _present(self._node, self.subscription.topic_name):
            return
        self._publisher = b""
        self._ended()
        ended, self.subscription = self.subscription, self._subscribed()
        self._node.destroy_subscription(ended)

    def _subscribed(self) -> Subscription[Any]:
        return self._node.create_subscription(
            self._kind, self._topic, self._on_message, qos.latched(), callback_group=self._group
        )

    def _on_message(self, message: Any, info: Mapping[str, Any]) -> None:
        self._take(message)
        self._publisher = _publisher(info)


def age_s(node: Node, info: Mapping[str, Any], stamp_ns: int) -> float:
    """Return the age of a message on arrival by this node's clock, however late it is taken."""
    clock = node.get_clock()
    simulated = isinstance(clock, ROSClock) and clock.ros_time_is_active
    received_ns = clock.now().nanoseconds if simulated else int(info["received_timestamp"])
    return (received_ns - stamp_ns) * 1e-9


def publishers_fault(node: Node, topic: str) -> str:
    """Return why a topic does not have exactly one publisher, ``""`` when it does."""
    full = node.resolve_topic_name(topic)
    names = sorted(end.node_name for end in node.get_publishers_info_by_topic(full))
    if len(names) == 1:
        return ""
    if not names:
        return f"no publisher of {full}"
    found = f"{full} has {len(names)} publishers ({', '.join(names)[:100]})"
    return f"{found}; stop all but one, a killed one is listed for 20 s"


def _present(node: Node, topic: str) -> set[bytes]:
    """Return the identities of a topic's publishers."""
    return {bytes(end.endpoint_gid) for end in node.get_publishers_info_by_topic(topic)}


def _publisher(info: Mapping[str, Any]) -> bytes:
    """Return the identity of a message's publisher, ``b""`` where rclpy does not give it."""
    gid = info.get("publisher_gid")
    return bytes(gid["data"]) if gid else b""
