"""What is given to a node at its start and would have no effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from rclpy.node import Node

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.yaml_file import read_yaml
from eschorty_ros.nodes.ros.parameters import check_name


def refuse_unused(node: Node, words: Sequence[str]) -> None:
    """Refuse quality of service of no topic, and a parameter file that names the node elsewhere.

    ROS leaves them out silently: a limit of the laser's voltage would have no effect. A file's
    entry of the node's name in another namespace counts when all its parameters are those of the
    node, and the file has no entry of the node itself.

    - ``words``: The process's command line.

    Raises ``ArgumentError`` with what is refused and what was probably meant.
    """
    declared = list(node.get_parameters_by_prefix(""))
    for name in node._parameter_overrides:
        check_name(name, f"parameter of {node.get_name()}", declared)
    full = node.get_fully_qualified_name()
    for option, path in pairwise(words):
        if option == "--params-file" and full not in (entries := _entries(path)):
            for name, values in entries.items():
                same = name.rpartition("/")[2] == node.get_name()
                if same and values and all(map(node.has_parameter, values)):
                    raise ArgumentError(
                        f"{Path(path).name} has parameters of {name} and none of {full}; give the "
                        "node that namespace (-r __ns:=), or write its name in the file"
                    )


def _entries(path: str) -> dict[str, list[str]]:
    """Return the parameters by full node name; nothing of files with wildcards or of other form."""
    try:
        data = read_yaml(path, FormatError).data
    except FormatError:
        return {}
    if not isinstance(data, dict) or any("*" in str(name) for name in data):
        return {}
    return {
        f"/{str(name).lstrip('/')}": list(table["ros__parameters"])
        for name, table in data.items()
        if isinstance(table, Mapping) and isinstance(table.get("ros__parameters"), Mapping)
    }
