"""All nodes in one process beside a client's own node, the emulated bench in another process."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import rclpy
import yaml
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.base.files import temporary_folder
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.emulation.bench.process import START_S, bench_process
from eschorty_ros.nodes.camera.node import CameraNode
from eschorty_ros.nodes.laser.node import LaserNode
from eschorty_ros.nodes.reconstruction.node import ReconstructionNode
from eschorty_ros.nodes.ros.alone import SecondNodes
from eschorty_ros.nodes.ros.dds import use_profile
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.nodes.ros.drivers import REAL
from eschorty_ros.nodes.ros.executor import Spinning
from eschorty_ros.nodes.ros.spin import end_nodes, signals_ignored
from eschorty_ros.nodes.ros.unused import refuse_unused
from eschorty_ros.nodes.scanner.node import ScannerNode
from eschorty_ros.nodes.stage.node import StageNode
from eschorty_ros.nodes.viewer.node import ViewerNode

NAMESPACE = "/eschorty"
NODES = {
    "camera": CameraNode,
    "laser": LaserNode,
    "stage": StageNode,
    "reconstruction": ReconstructionNode,
    "scanner": ScannerNode,
}
THREADS = 12
_POLL_S = 0.02

FEEDBACK_TIMEOUT_S = 300.0

Tables = dict[str, dict[str, Any]]
"""Parameters by node."""


def bench_parameters() -> Tables:
    """Return parameters of the nodes at a bench whose stage triggers the camera.

    No event is lost, because an emulated camera can wait.
    """
    topic = f"{NAMESPACE}/camera/events"
    tables: Tables = {
        node: {"qos_overrides": {topic: {end: {"reliability": "reliable"}}}}
        for node, end in (("camera", "publisher"), ("reconstruction", "subscription"))
    }
    tables["camera"]["trigger_in_mode"] = "external"
    tables["reconstruction"]["trigger_source"] = "stage"
    return tables


class Composition:
    """The running nodes and a client's node among them, with the client of one action."""

    def __init__(self, client: Node, nodes: list[Node], action: Any, spinning: Spinning) -> None:
        self.client = client
        self.nodes = nodes
        self._spinning = spinning
        self._action = action

    def wait_until_active(self, feedback: Progress) -> None:
        """Wait until every node is active and the action's server has been discovered.

        ``feedback`` is called with what is missing. Raises ``DeviceError`` when a node failed or
        takes far too long.
        """

        def active() -> bool:
            feedback(0.0, "; ".join(self._waiting()) or "starting")
            return self._active() and bool(self._action.server_is_ready())

        wait(
            active,
            START_S,
            lambda: "; ".join(("the nodes are not active", *self._waiting())),
        )

    def result(self, goal: Any, on_feedback: Callable[[Any], None], starting: Progress) -> Any:
        """Send a goal once all nodes are active; return its result. An interruption cancels it.

        ``starting`` is called with what is missing until then.

        Raises ``DeviceError`` when a node fails, or the server refuses the goal or sends no
        feedback any more.
        """
        self.wait_until_active(starting)
        newest_s = time.monotonic()

        def receive(message: Any) -> None:
            nonlocal newest_s
            newest_s = time.monotonic()
            on_feedback(message)

        sent = self._action.send_goal_async(goal, feedback_callback=receive)
        wait(sent.done, START_S, "the action does not answer")
        handle = sent.result()
        if handle is None or not handle.accepted:
            raise DeviceError("the goal was refused; see the message above")
        finished = handle.get_result_async()
        try:
            # A slow machine may take any time: only a lack of feedback ends the wait.
            while not finished.done():
                self._spinning.raise_error()
                if time.monotonic() - newest_s > FEEDBACK_TIMEOUT_S:
                    raise DeviceError(f"no feedback of the action for {FEEDBACK_TIMEOUT_S:.0f} s")
                time.sleep(_POLL_S)
        except BaseException:
            handle.cancel_goal_async()
            raise
        return finished.result().result

    def _waiting(self) -> list[str]:
        return [
            f"{node.get_name()}: {reason}"
            for node in self.nodes
            if (reason := getattr(node, "waiting", ""))
        ]

    def _active(self) -> bool:
        self._spinning.raise_error()
        failed = [
            f"{node.get_name()}: {reason.splitlines()[-1]}"
            for node in self.nodes
            if (reason := getattr(node, "failure", ""))
        ]
        if failed:
            raise DeviceError("; ".join(failed))
        return all(getattr(node, "active", True) for node in self.nodes)


@contextlib.contextmanager
def composition(
    values: Tables, action: tuple[Any, str], bench: Mapping[str, object] | None = None
) -> Iterator[Composition]:
    """Run all nodes with these parameters inside the context; the laser is off on every exit.

    ``action`` is the type and the name of the action that is to be called.
    A table ``viewer`` adds the page in the browser.
    With ``bench``, options of ``eschorty-bench``, another process emulates the devices. Unless
    ``ROS_DOMAIN_ID`` is set, the nodes get a domain of their own, apart from other instruments.
    """
    use_profile()
    with contextlib.ExitStack() as ending:
        folder = ending.enter_context(temporary_folder())
        tables = {name: dict(table) for name, table in values.items()}
        if bench is not None:
            for name in REAL:
                tables.setdefault(name, {})["bench"] = str(folder / "bench")
            ending.enter_context(bench_process(folder / "bench", bench))
        file = folder / "parameters.yaml"
        file.write_text(_parameter_file(tables))
        factories = [*NODES.values(), *([ViewerNode] if "viewer" in tables else [])]
        yield ending.enter_context(_running(file, factories, *action))


@contextlib.contextmanager
def _running(
    parameter_file: Path, factories: Iterable[Callable[[], Node]], kind: Any, action: str
) -> Iterator[Composition]:
    nodes: list[Node] = []
    second: SecondNodes | None = None
    rclpy.init(
        args=[
            "--ros-args",
            *("-r", f"__ns:={NAMESPACE}"),
            *("--params-file", str(parameter_file)),
            *("--log-level", "warn"),
        ],
        domain_id=None if os.environ.get("ROS_DOMAIN_ID") else free_domain(),
        signal_handler_options=SignalHandlerOptions.NO,
    )
    spinning = Spinning(THREADS)
    try:
        for factory in factories:
            nodes.append(factory())
            refuse_unused(nodes[-1], ())
        nodes.append(client := Node("eschorty_client"))
        # Before the nodes spin: an executor must not use a client that is being made.
        made = Composition(client, nodes, ActionClient(client, kind, action), spinning)
        for node in nodes:
            spinning.executor.add_node(node)
        if os.environ.get("ROS_DOMAIN_ID"):
            second = SecondNodes(nodes)
            second.wait()
        spinning.start()
        yield made
    finally:
        with signals_ignored():
            end_nodes(nodes, second, spinning)


def _parameter_file(values: Tables) -> str:
    return yaml.safe_dump(
        {f"{NAMESPACE}/{node}": {"ros__parameters": table} for node, table in values.items()}
    )


def wait(condition: Callable[[], Any], limit_s: float, fault: str | Callable[[], str]) -> None:
    """Wait for ``condition``; raise ``DeviceError`` with ``fault`` after ``limit_s``."""
    # Polling in the main thread lets Ctrl-C interrupt it.
    end_s = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end_s:
            text = fault if isinstance(fault, str) else fault()
            raise DeviceError(f"{text} after {limit_s:.0f} s; look at the log above")
        time.sleep(_POLL_S)
