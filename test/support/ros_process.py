"""Helpers of the process tests: nodes as processes of their own, in a private ROS domain."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import rclpy
import waiting
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from waiting import DEADLINE_S

from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.nodes.ros.dds import use_profile
from eschorty_ros.nodes.ros.dds_deadlock import DdsDeadlock
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.nodes.ros.executor import Spinning
from eschorty_ros.nodes.ros.repeated_call import RepeatedCall

NAMESPACE = "/eschorty"
# With util-linux the kernel ends the nodes however the tests end.
_ENDING_WITH_PARENT = ("setpriv", "--pdeathsig", "TERM") if shutil.which("setpriv") else ()
_DDS = DdsDeadlock()


def wait_until(
    condition: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S, poll_s: float = 0.02
) -> Any:
    """As ``waiting.wait_until``; fails after some 10 s where DDS is deadlocked in this process."""

    def look() -> Any:
        _DDS.look()
        return condition()

    return waiting.wait_until(look, what, deadline_s, poll_s)


def ros_minus_steady_ns() -> int:
    """ROS time minus CLOCK_MONOTONIC, from the pair of readings least far apart of many."""
    pairs = []
    for _ in range(100):
        before_ns, ros_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        pairs.append((after_ns - before_ns, ros_ns - (before_ns + after_ns) // 2))
    return min(pairs)[1]


def stamped_after(messages: list[Any], t_ns: int) -> bool:
    """Return whether the newest message is stamped later than ``t_ns``."""
    return bool(messages) and ns_from_stamp(messages[-1].header.stamp) > t_ns


class Remap(str):
    """Another name, given in place of a parameter's value."""


class NodeProcess:
    """A module with one node, as a process of its own until ``kill`` or the end of a ``with``.

    Start it in the main thread: it ends with the thread that started it. The report of a test
    that fails shows the end of its output.
    """

    known: ClassVar[list[NodeProcess]] = []

    def __init__(
        self, module: str, parameters: Mapping[str, Any], *, domain: int, file: Path | None = None
    ) -> None:
        self.module = module
        self._log = tempfile.NamedTemporaryFile(  # noqa: SIM115 - closed in kill()
            prefix=f"{node_name(module)}_", suffix=".log"
        )
        command = [*_ENDING_WITH_PARENT, sys.executable, "-m", module]
        command += ["--ros-args", "-r", f"__ns:={NAMESPACE}"]
        for name, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ["-r" if isinstance(value, Remap) else "-p", f"{name}:={text}"]
        if file is not None:
            command += ["--params-file", str(file)]
        self._process = subprocess.Popen(
            command,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            env=domain_environment(domain),
            process_group=0,
        )
        self._killed_with: str | None = None
        self.known.append(self)

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def output(self) -> str:
        """Everything the process has printed."""
        if self._killed_with is not None:
            return self._killed_with
        return Path(self._log.name).read_text(errors="replace")

    @property
    def end_of_output(self) -> str:
        """The last it has printed; after a crash all from the crash on."""
        output = self.output
        crash = output.rfind("Fatal Python error")
        return output[crash if crash >= 0 else -3000 :]

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self) -> int:
        """Exit code; fails with the output when the process does not end in time."""
        try:
            return self._process.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self.module} still runs:\n{self.output}") from None

    def running(self) -> bool:
        return self._process.poll() is None

    def interrupt(self) -> int:
        """SIGINT, then the exit code."""
        if self.running():
            self.send(signal.SIGINT)
        return self.wait()

    def kill(self, timeout_s: float = 20.0) -> None:
        """End the process: SIGTERM first, as a killed process leaves its shared memory."""
        if self.running():
            self.send(signal.SIGCONT)
            self.send(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout_s)
        if self.running():
            self._process.kill()
        self._process.wait()
        self._killed_with = self.output
        self._log.close()


def node_name(module: str) -> str:
    """Name of the node that ``module`` of the package runs."""
    return module.removeprefix("eschorty_ros.nodes.").split(".")[0]


def domain_environment(domain: int) -> dict[str, str]:
    """Of a process in ``domain``, on this host unless chosen otherwise; a crash shows where."""
    return {
        **os.environ,
        "PYTHONFAULTHANDLER": "1",
        "PYTHONPATH": f"{Path(__file__).parent}:{os.environ.get('PYTHONPATH', '')}",
        "ROS_DOMAIN_ID": str(domain),
        "PYTHONUNBUFFERED": "1",
    }


class EarlyLocked(ActionClient):
    """An action client that may be made while its node spins: rclpy adds it before its lock."""

    _lock = threading.Lock()


@contextlib.contextmanager
def nodes_here(domain: int, threads: int = 1) -> Iterator[Callable[..., Any]]:
    """Yield a function that makes nodes in this process: ``(kind, **parameters)``; spin them."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    spinning = Spinning(threads, context)
    nodes = []

    def start(kind: Callable[..., Any], **parameters: Any) -> Any:
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = kind(context=context, namespace=NAMESPACE, parameter_overrides=overrides)
        nodes.append(node)
        spinning.executor.add_node(node)
        return node

    spinning.start()
    try:
        yield start
        for node in nodes:
            node.safe_state()
    finally:
        spinning.end()
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


class Observer:
    """A test's own node, spun in a thread until the end of a ``with``."""

    def __init__(self, domain: int | None = None) -> None:
        use_profile()
        self.domain = free_domain() if domain is None else domain
        context = rclpy.Context()
        with contextlib.ExitStack() as stack:
            rclpy.init(context=context, domain_id=self.domain)
            stack.callback(context.try_shutdown)
            self.node = Node("observer", namespace=NAMESPACE, context=context)
            stack.callback(self.node.destroy_node)
            spinning = Spinning(1, context)
            spinning.executor.add_node(self.node)
            stack.callback(spinning.end)
            spinning.start()
            self._stack = stack.pop_all()

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def action_client(self, kind: Any, name: str) -> ActionClient:
        """An action's client."""
        return EarlyLocked(self.node, kind, name)

    def collect(self, message_type: Any, topic: str, profile: QoSProfile) -> list[Any]:
        """A list that grows by every message of ``topic`` from now on."""
        messages: list[Any] = []
        self.node.create_subscription(message_type, topic, messages.append, profile)
        return messages

    def publisher(self, message_type: Any, topic: str, profile: QoSProfile) -> Any:
        """A publisher that has already found a subscriber."""
        publisher = self.node.create_publisher(message_type, topic, profile)
        wait_until(publisher.get_subscription_count, f"a subscriber of {topic}")
        return publisher

    def call(self, service_type: Any, name: str, request: Any = None) -> Any:
        """The service's response; the service's name begins with that of its node."""
        with self._client(service_type, name, DEADLINE_S) as client:
            # A server that has not discovered the client yet would not answer it.
            self.wait_for_answers(name.split("/")[0])
            future = client.call_async(request if request is not None else service_type.Request())
            wait_until(future.done, f"answer of {name}")
            return future.result()

    def ask(self, service_type: Any, name: str, deadline_s: float = DEADLINE_S) -> Any:
        """Response of a service that may be called again: a first answer can get lost.

        A fresh server may not know yet where its answers go, a killed one seems to be there still.
        """
        with self._client(service_type, name, deadline_s) as client:
            call = RepeatedCall(client, service_type.Request(), again=True)
            wait_until(call.done, f"an answer of {name}", deadline_s)
            return call.result()

    @contextlib.contextmanager
    def _client(self, service_type: Any, name: str, deadline_s: float) -> Iterator[Any]:
        client = self.node.create_client(service_type, name)
        try:
            wait_until(client.service_is_ready, f"service {name}", deadline_s)
            yield client
        finally:
            self.node.destroy_client(client)

    def wait_for_answers(self, node: str, deadline_s: float = DEADLINE_S) -> None:
        """Wait until ``node`` answers.

        Endpoints are discovered in the order of their making, so what this observer made before
        gets its answers, too.
        """
        self.ask(GetParameters, f"{node}/get_parameters", deadline_s)

    def lifecycle_state(self, node: str) -> str:
        return str(self.ask(GetState, f"{node}/get_state").current_state.label)

    def wait_for_state(self, node: str, label: str) -> None:
        wait_until(lambda: self.lifecycle_state(node) == label, f"{node} {label}", poll_s=0.1)

    def change_state(self, node: str, transition: str) -> bool:
        """Ask ``node`` for a transition by label, e.g. ``deactivate``; whether it succeeded."""
        request = ChangeState.Request(transition=Transition(label=transition))
        return bool(self.call(ChangeState, f"{node}/change_state", request).success)

    def set_parameter(self, node: str, name: str, value: Any) -> tuple[bool, str]:
        """Set one parameter of ``node``: accepted, reason."""
        message: ParameterMsg = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        result = self.call(SetParameters, f"{node}/set_parameters", request).results[0]
        return bool(result.successful), str(result.reason)


@contextlib.contextmanager
def processes(
    nodes: Mapping[str, Mapping[str, Any]], domain: int
) -> Iterator[dict[str, NodeProcess]]:
    """Run ``{module: parameters}`` side by side, keyed by the node's name; killed at the end."""
    running = {
        node_name(module): NodeProcess(module, parameters, domain=domain)
        for module, parameters in nodes.items()
    }
    try:
        yield running
    finally:
        for process in running.values():
            if process.running():
                process.send(signal.SIGTERM)
        for process in running.values():
            process.kill()
