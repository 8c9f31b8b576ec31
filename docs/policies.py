"""Writes config/sros2/<node>.policy.xml: what each node publishes, reads, calls and serves.

Usage: python docs/policies.py (or make reference). docs/sros2.md says how they are used.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from interfaces import NAMESPACE, every_node
from rclpy.action import (
    get_action_client_names_and_types_by_node,
    get_action_server_names_and_types_by_node,
)
from rclpy.node import Node

FOLDER = Path(__file__).parents[1] / "config" / "sros2"
OPERATOR = "operator"
# What a person at a terminal may do: start, stop and look, but neither switch the laser on nor keep
# it on.
OPERATOR_CALLS = {"scan", "calibrate", "stage/move"}
OPERATOR_REQUESTS = {"laser/reset_interlock", "laser/enable"}
# The nodes that the commands of `ros2` make for themselves: a service that is refused ends them.
_COMMAND_NODES = "/_ros2cli*"
_COMMON_TOPICS = ("/rosout", "/parameter_events")
_HIDDEN = "/_action/"

# What a node makes when it is needed.
_LIGHT: dict[tuple[str, str], set[str]] = {
    ("actions", "call"): {"calibrate"},
    ("topics", "subscribe"): {
        "laser/transition_event",
        "reconstruction/state",
        "reconstruction/heartbeat",
        "stage/limits",
    },
}
ON_DEMAND = {"reconstruction": _LIGHT, "scanner": {("actions", "call"): {"scan"}}}

Rights = dict[tuple[str, str], set[str]]
"""Names by element and right, such as ``("topics", "publish")``."""


def rights(node: Node) -> Rights:
    """Return the full names that a node uses, by element and right."""
    own = node.get_name(), node.get_namespace()
    found: Rights = {
        ("actions", "execute"): _names(get_action_server_names_and_types_by_node(node, *own)),
        ("actions", "call"): _names(get_action_client_names_and_types_by_node(node, *own)),
        ("services", "reply"): _names(node.get_service_names_and_types_by_node(*own)),
        ("services", "request"): _names(node.get_client_names_and_types_by_node(*own)),
        ("topics", "publish"): _names(node.get_publisher_names_and_types_by_node(*own)),
        ("topics", "subscribe"): _names(node.get_subscriber_names_and_types_by_node(*own)),
    }
    later = ON_DEMAND.get(node.get_name(), {})
    return {
        key: {name for name in names if _HIDDEN not in name}
        | {f"{NAMESPACE}/{name}" for name in later.get(key, ())}
        for key, names in found.items()
    }


def operator_rights(nodes: list[Rights]) -> Rights:
    """Return those of a person at a terminal."""
    published = {name for table in nodes for name in table["topics", "publish"]}
    served = {name for table in nodes for name in table["services", "reply"]}
    executed = {name for table in nodes for name in table["actions", "execute"]}
    # Those that every node has, for its parameters and types.
    own = set.intersection(
        *({name.rpartition("/")[2] for name in table["services", "reply"]} for table in nodes)
    )
    harmless = ("/get_parameters", "/list_parameters", "/get_state", "/dump_statistics")
    return {
        ("actions", "call"): executed & {f"{NAMESPACE}/{name}" for name in OPERATOR_CALLS},
        ("services", "reply"): {f"{_COMMAND_NODES}/{name}" for name in own},
        ("services", "request"): {
            name
            for name in served
            if name.endswith(harmless) or name.removeprefix(f"{NAMESPACE}/") in OPERATOR_REQUESTS
        },
        ("topics", "publish"): set(_COMMON_TOPICS),
        ("topics", "subscribe"): published,
    }


def policy(node: str, table: Rights) -> str:
    """Return the policy of one enclave, which has the node's full name."""
    root = ElementTree.Element("policy", version="0.2.0")
    enclave = ElementTree.SubElement(
        ElementTree.SubElement(root, "enclaves"), "enclave", path=f"{NAMESPACE}/{node}"
    )
    profile = ElementTree.SubElement(
        ElementTree.SubElement(enclave, "profiles"), "profile", ns=NAMESPACE, node=node
    )
    for (element, right), names in table.items():
        if names:
            group = ElementTree.SubElement(profile, element, {right: "ALLOW"})
            for name in sorted(names):
                ElementTree.SubElement(group, element.removesuffix("s")).text = name
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def policies(nodes: Iterable[Node]) -> dict[str, str]:
    """Return the policies by node, and the operator's."""
    tables = {node.get_name(): rights(node) for node in nodes}
    tables[OPERATOR] = operator_rights(list(tables.values()))
    return {node: policy(node, table) for node, table in tables.items()}


def file_of(node: str) -> Path:
    """Return the path of a node's policy."""
    return FOLDER / f"{node}.policy.xml"


def _names(found: Iterable[tuple[str, list[str]]]) -> set[str]:
    return {name for name, _ in found}


if __name__ == "__main__":
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    FOLDER.mkdir(exist_ok=True)
    with every_node() as made:
        for name, text in policies(made).items():
            file_of(name).write_text(text, encoding="utf-8")
