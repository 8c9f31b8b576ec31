"""Writes the tables of docs/interfaces.md from the nodes: topics, services, actions, parameters.

Usage: python docs/interfaces.py (or make reference).
"""

from __future__ import annotations

import os
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import rclpy
from rclpy.action import get_action_server_names_and_types_by_node
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from eschorty_ros.nodes.one_process.composition import NODES
from eschorty_ros.nodes.one_process.hardware_file import TABLES
from eschorty_ros.nodes.replay import node as replay
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.nodes.ros.drivers import REAL
from eschorty_ros.nodes.ros.lifecycle import AUTO_START
from eschorty_ros.nodes.ros.parameters import Param
from eschorty_ros.nodes.viewer import node as viewer

PAGE = Path(__file__).with_suffix(".md")
NAMESPACE = "/eschorty"

PARAMETERS = {
    name: (AUTO_START, *table) if name in REAL else table for name, table in TABLES.items()
}
TOPICS = {
    "camera/events": "raw EVT3; stamp: arrival of the first byte; `seq` without gaps",
    "camera/clock": "ROS time (`header.stamp`) of a sensor time (`time_ref`); optional",
    "camera/heartbeat": "10 Hz while events can come",
    "laser/state": "read-back and requested output, modulation, reason; changes, 2 Hz at least",
    "laser/heartbeat": "10 Hz while the sender wants light; the reconstruction when it calibrates",
    "laser/interlock": "true: open, laser off until closed by all that publish it and reset",
    "stage/odom": "position along the stage in `pose.pose.position.y`, speed in `twist`",
    "stage/limits": "travel, speed and acceleration of its moves",
    "stage/trigger": "positions of the stage's pulses to the camera",
    "stage/heartbeat": "10 Hz while the stage is active",
    "profile": "one profile in `eschorty_link`; `profile_rate_max` at most",
    "points": "batches in `eschorty_base`, 20 Hz at most",
    "scan/points": "the last scan with points, assembled, in `eschorty_base`",
    "event_frame": "recent events, `mono8`, 10 Hz at most",
    "reconstruction/state": "progress and losses, 5 Hz",
    "reconstruction/heartbeat": "10 Hz while it works; a scan ends without it",
    "reconstruction/calibration": "the calibration in use",
    "/diagnostics": "health of each node, 1 Hz",
    "/tf": "carriage in the base, from `stage/odom`",
    "/tf_static": "carriage to link to optical frame",
}
SERVICES = {
    "camera/save_biases": "the camera's biases into `bias_file`",
    "camera/dump_statistics": "counters into the answer and the log",
    "laser/arm": "allows `laser/enable` for `arm_timeout`",
    "laser/enable": "light on or off; refused with the reason",
    "laser/reset_interlock": "undo the latch of an interlock that was opened",
    "reconstruction/begin_scan": "collect points for `scan/points`",
    "reconstruction/end_scan": "publish them, and report what was lost",
    "reconstruction/load_calibration": "use another calibration of the same instrument",
    "reconstruction/save_calibration": "write the one in use",
    "scan": "to start, laser on, sweep, laser off",
    "calibrate": "targets of known range to a calibration",
    "stage/move": "cancel is a profiled stop",
}


@dataclass
class Topic:
    """Ends of a topic: nodes, each with its quality of service."""

    type: str = ""
    publishers: dict[str, str] = field(default_factory=dict)
    subscribers: dict[str, str] = field(default_factory=dict)

    @property
    def qos(self) -> str:
        """The publishers' quality of service; the subscribers' without a publisher."""
        first, *others = (self.publishers or self.subscribers).items()
        differing = [f"{node}: {offered}" for node, offered in others if offered != first[1]]
        return "; ".join([first[1], *differing])


@contextmanager
def every_node() -> Iterator[list[Node]]:
    """All nodes at rest, without devices."""
    options = ("-r", f"__ns:={NAMESPACE}", "--log-level", "error")
    rclpy.init(args=["--ros-args", *options], domain_id=free_domain())
    resting = [Parameter("auto_start", value=False)]
    playing = [Parameter("recording", value="none")]
    nodes: list[Node] = []
    try:
        nodes += [
            make(parameter_overrides=resting if name in REAL else [])
            for name, make in NODES.items()
        ]
        # The replay's ends do not depend on what it plays.
        with (
            mock.patch.object(replay, "load_recording"),
            mock.patch.object(replay, "RawReader"),
            mock.patch.object(replay.ReplayNode, "_run"),
        ):
            nodes.append(replay.ReplayNode(threading.Event(), parameter_overrides=playing))
        with mock.patch.object(viewer, "Page"):
            nodes.append(viewer.ViewerNode())
        yield nodes
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
        # The level is one of the process, of later tests, too.
        set_logger_level("", LoggingSeverity.INFO)


def topics(nodes: list[Node]) -> dict[str, Topic]:
    """Every topic of the nodes, without those that every node of ROS has."""
    found: dict[str, Topic] = defaultdict(Topic)
    for node in nodes:
        for end in (*node.publishers, *node.subscriptions):
            topic = found[_short(end.topic_name)]
            topic.type = _type(end.msg_type)
            ends = topic.publishers if isinstance(end, Publisher) else topic.subscribers
            ends[node.get_name()] = _quality(end.qos_profile)
    return {name: topic for name, topic in found.items() if not _common(name)}


def services(nodes: list[Node]) -> dict[str, tuple[str, str]]:
    """Kind and type of every service and action, without those that every node of ROS has."""
    found = {}
    for node in nodes:
        for service in node.services:
            name = service.srv_name.replace("~", node.get_name())
            found[_short(name)] = ("service", _type(service.srv_type))
        own = node.get_name(), node.get_namespace()
        for name, (kind, *_) in get_action_server_names_and_types_by_node(node, *own):
            found[_short(name)] = ("action", kind.replace("/action/", "/"))
    return {name: kind for name, kind in found.items() if not _common(name)}


def topic_table(nodes: list[Node]) -> str:
    """Topics in the order of ``TOPICS``; one that is missing there has no description."""
    lines = ["| topic | type | from | to | QoS | what |", "| --- | --- | --- | --- | --- | --- |"]
    found = topics(nodes)
    for name in sorted(found, key=lambda name: _rank(TOPICS, name)):
        topic = found[name]
        ends = (_names(topic.publishers), _names(topic.subscribers))
        cells = (f"`{name}`", f"`{topic.type}`", *ends, topic.qos, TOPICS.get(name, ""))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def service_table(nodes: list[Node]) -> str:
    """Services and actions in the order of ``SERVICES``."""
    lines = ["| name | kind | type | what |", "| --- | --- | --- | --- |"]
    found = services(nodes)
    for name in sorted(found, key=lambda name: _rank(SERVICES, name)):
        kind, type_name = found[name]
        lines.append(f"| `{name}` | {kind} | `{type_name}` | {SERVICES.get(name, '')} |")
    return "\n".join(lines) + "\n"


def parameter_tables() -> str:
    """One table for each node."""
    parts = []
    for node, table in PARAMETERS.items():
        lines = [f"### `{node}`", "", "| parameter | default | range | what |"]
        lines += ["| --- | --- | --- | --- |", *map(_parameter, table)]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def replaced(page: str, name: str, table: str) -> str:
    """``page`` with the table between the marks of that name."""
    begin, end = f"<!-- {name}: made by `make reference` -->\n", f"<!-- end of {name} -->"
    head, rest = page.split(begin)
    return head + begin + "\n" + table + "\n" + end + rest.split(end)[1]


def _parameter(param: Param) -> str:
    value = param.default
    if isinstance(value, bool):
        default = str(value).lower()
    elif isinstance(value, tuple):
        default = ", ".join(map(str, value))
    else:
        default = f"{value:g}" if isinstance(value, float) else str(value)
    if param.choices:
        span = ", ".join(f"`{choice}`" for choice in param.choices)
    elif param.minimum is not None and param.maximum is not None:
        span = f"{_number(param.minimum)} to {_number(param.maximum)}"
    else:
        span = ""
    unit = f", {param.unit}" if param.unit else ""
    what = param.description.replace("|", "\\|").replace("*", "\\*")
    name = f"`{param.name}`" + (" (live)" if param.dynamic else "")
    shown = f"`{default}`" if default else "empty"
    return f"| {name} | {shown} | {span}{unit if span else unit[2:]} | {what} |"


def _number(value: float) -> str:
    return f"{value:.10g}"


def _rank(described: dict[str, str], name: str) -> tuple[int, str]:
    return (list(described).index(name) if name in described else len(described), name)


def _names(nodes: Iterable[str]) -> str:
    absent = set(PARAMETERS) - set(nodes)
    return f"all but {absent.pop()}" if len(absent) == 1 else ", ".join(sorted(nodes))


def _type(message: Any) -> str:
    return f"{message.__module__.split('.')[0]}/{message.__name__}"


def _short(name: str) -> str:
    return name.removeprefix(NAMESPACE + "/")


def _common(name: str) -> bool:
    """Return whether every node, or every lifecycle node, has it."""
    parameters = ("_parameters", "_parameters_atomically", "_parameter_types")
    lifecycle = ("_state", "_states", "_transitions", "_graph", "transition_event")
    others = ("/rosout", "/parameter_events", "_type_description")
    return name == "/clock" or name.endswith((*parameters, *lifecycle, *others))


def _quality(profile: QoSProfile) -> str:
    if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        return f"latched, {profile.depth}"
    kind = "reliable" if profile.reliability == ReliabilityPolicy.RELIABLE else "best effort"
    return f"{kind}, {profile.depth}"


def page() -> str:
    """Make the page as it should be."""
    text = PAGE.read_text(encoding="utf-8")
    with every_node() as nodes:
        text = replaced(text, "topics", topic_table(nodes))
        text = replaced(text, "services", service_table(nodes))
    return replaced(text, "parameters", parameter_tables())


if __name__ == "__main__":
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    PAGE.write_text(page(), encoding="utf-8")
