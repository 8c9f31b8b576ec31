"""Two nodes of one name: the second one refuses to start."""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Sequence

from rclpy.node import Node
from rclpy.parameter import Parameter

from eschorty_ros.control.heartbeat import place
from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.hardware.base.stalls import process_ended

# Discovery takes some 0.2 s, and seconds on a busy host.
_BEFORE_SPIN_S = 1.0
_LOOK_S = 10.0
_POLL_S = 0.1
_HERE = hashlib.blake2b(place().encode(), digest_size=8).hexdigest()


class SecondNodes:
    """Looks for other nodes of these names for 10 s, the first second before the nodes are spun.

    A hidden node marks each one, with its state and start: one that runs stays, and of two that
    start together the first one. A node that was killed on this host counts no more, though
    discovery holds its name for some seconds.

    Public attributes:
    - ``looking``: False when the 10 s are over.
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._marks = [_Mark(node) for node in nodes]
        self._begun_s = self._looked_s = time.monotonic()
        self.looking = True

    def wait(self) -> None:
        """Look before the nodes are spun; see ``look``."""
        while time.monotonic() - self._begun_s < _BEFORE_SPIN_S:
            if not all(mark.node.context.ok() for mark in self._marks):
                return
            self.look()
            time.sleep(_POLL_S)
        for mark in self._marks:
            mark.set("runs")

    def look(self) -> None:
        """Look for other nodes of these names when that is due.

        Raises ``DeviceError`` when another node of a name runs, or has begun to start earlier.
        """
        now_s = time.monotonic()
        if self.looking and now_s - self._looked_s >= _POLL_S:
            self._looked_s = now_s
            self.looking = now_s - self._begun_s < _LOOK_S
            for mark in self._marks:
                mark.check()

    def end(self) -> None:
        """Remove the marks."""
        while self._marks:
            self._marks.pop().remove()


class _Mark:
    """Name of a hidden node beside a node, from which those of the same name know its state."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._name = re.compile(
            rf"_{re.escape(node.get_name())}_(runs|starts)_([0-9]+)_([0-9]+)_([0-9a-f]+)"
        )
        self._begun = time.time_ns(), os.getpid()
        self._shown: Node | None = None
        self.set("starts")

    def set(self, state: str) -> None:
        """Show another state."""
        before, self._state = self._shown, state
        self._shown = Node(
            f"_{self.node.get_name()}_{state}_{self._begun[0]}_{self._begun[1]}_{_HERE}",
            namespace=self.node.get_namespace(),
            context=self.node.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            # It would not answer, because nothing spins the mark.
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )
        if before is not None:
            before.destroy_node()

    def remove(self) -> None:
        if self._shown is not None:
            self._shown.destroy_node()

    def check(self) -> None:
        space = self.node.get_namespace()
        names = [name for name, of in self.node.get_node_names_and_namespaces() if of == space]
        found = [mark.groups() for name in names if (mark := self._name.fullmatch(name))]
        first = min(
            (
                (state, int(ns), int(pid))
                for state, ns, pid, where in found
                if where != _HERE or not process_ended(int(pid))
            ),
            default=None,
        )
        # "runs" is before "starts".
        if first is not None and first < (self._state, *self._begun):
            raise DeviceError(
                f"another node {self.node.get_fully_qualified_name()} runs in this ROS domain; "
                "end it, or give this one another name (-r __node:=) or namespace (-r __ns:=)"
            )
