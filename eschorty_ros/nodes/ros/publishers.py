"""Names of the nodes whose messages arrive: the identity of a message's publisher."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rclpy.node import Node

_KEPT = 64
_GID_BYTES = 16
_UNKNOWN = "_NODE_NAME_UNKNOWN_"


class Publishers:
    """The publishers of one topic, by the global id that comes with every message.

    rclpy before Kilted gives no id: every publisher is ``""`` then, and nameless.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._names: dict[str, str] = {}

    def id(self, info: Mapping[str, Any]) -> str:
        """Return the global id of a message's publisher as text."""
        gid = info.get("publisher_gid")
        data = gid.get("data") if isinstance(gid, Mapping) else gid
        return _text(data) if data else ""

    def name(self, info: Mapping[str, Any]) -> str:
        """Return the full name of the node that published a message, ``""`` while it is unknown."""
        publisher = self.id(info)
        if not publisher:
            return ""
        if publisher not in self._names:
            for endpoint in self._node.get_publishers_info_by_topic(self._topic):
                if endpoint.node_name == _UNKNOWN:
                    continue
                name = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
                if len(self._names) >= _KEPT:
                    self._names.clear()
                self._names[_text(endpoint.endpoint_gid)] = name
        return self._names.get(publisher, "")


def _text(gid: Iterable[int]) -> str:
    return bytes(gid)[:_GID_BYTES].hex()
