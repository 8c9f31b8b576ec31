"""Waiting for other nodes in ticks, each with feedback and every reason to end."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node

from eschorty_ros.nodes.scan_monitor import ScanMonitor
from eschorty_ros.nodes.scan_sequence import ScanCanceled, ScanFailure

_TICK_S = 0.02
_RESEND_S = 2.0


class PacedClient:
    """Services of the other nodes, asked by a sequence that can be watched, canceled and ended.

    Its methods block, so they run in a thread of their own beside the executor's.

    Parameters
    ----------
    node : rclpy.node.Node
    services : mapping of str to service type
        What is asked, by name.
    service_timeout_s, events_timeout_s : float
        Longest wait for an answer, and for the events to go on.
    """

    def __init__(
        self,
        node: Node,
        services: Mapping[str, Any],
        service_timeout_s: float,
        events_timeout_s: float,
    ) -> None:
        self._node = node
        self._service_timeout_s = service_timeout_s
        self._events_timeout_s = events_timeout_s
        # In a group of its own, one message at a time, so that samples stay in order.
        self.monitor = ScanMonitor(node, MutuallyExclusiveCallbackGroup())
        self._group = ReentrantCallbackGroup()
        self._clients = {
            name: node.create_client(kind, name, callback_group=self._group)
            for name, kind in services.items()
        }
        self._tick_s = 0.0
        self._ended = threading.Event()
        self._watching = False
        self._shielded = False
        self._canceled: Callable[[], bool] = lambda: False
        self._feedback: Callable[[str], None] = lambda phase: None
        self._phase = ""

    def prepare(self, canceled: Callable[[], bool], feedback: Callable[[str], None]) -> None:
        """Reset for a new sequence; both callables are used at every ``pause``."""
        self._canceled, self._feedback = canceled, feedback
        self._watching = self._shielded = False
        self._phase = "preparing"
        self.monitor.samples.clear()

    def end(self) -> None:
        """Make every wait fail from now on."""
        self._ended.set()

    def watch(self, enabled: bool) -> None:
        """See ``Hands``."""
        self.monitor.restart_patience()
        self._watching = enabled

    def shield(self) -> None:
        """See ``Hands``."""
        self._shielded = True

    def drain(self, no_progress_s: float) -> None:
        """See ``Hands``."""
        target_ns = self._node.get_clock().now().nanoseconds
        self.monitor.restart_patience()
        while self.monitor.until_ns < target_ns:
            self._pause()
            self.monitor.check_progress(no_progress_s)

    def hold(self, duration_s: float) -> None:
        """Wait until the reconstruction has passed so much sensor time from now on."""
        target_ns = self._node.get_clock().now().nanoseconds + round(duration_s * 1e9)
        self.monitor.restart_patience()
        while self.monitor.until_ns < target_ns:
            self._pause()

    def report(self, phase: str) -> None:
        """See ``Hands``."""
        self._phase = phase
        # On the way out after a signal there is nobody left to tell.
        with contextlib.suppress(ScanFailure), self._living_context():
            self._feedback(phase)

    def _pause(self) -> None:
        """One tick: sign of life, feedback, and the reasons to end."""
        if self._ended.is_set() or not self._node.context.ok():
            raise ScanFailure(f"{self._node.get_name()}: the node was shut down")
        self._tick_s = time.monotonic()
        with self._living_context():
            self._feedback(self._phase)
        if self._watching:
            self.monitor.check_laser()
            self.monitor.check_progress(self._events_timeout_s)
        if not self._shielded and self._canceled():
            raise ScanCanceled
        time.sleep(_TICK_S)

    @contextlib.contextmanager
    def _uncanceled(self) -> Iterator[None]:
        """Within it a cancel has to wait."""
        before, self._shielded = self._shielded, True
        try:
            yield
        finally:
            self._shielded = before

    def _wait(
        self, condition: Callable[[], bool], timeout_s: float, failure: str | Callable[[], str]
    ) -> None:
        end_s = time.monotonic() + timeout_s
        while not condition():
            self._pause()
            if time.monotonic() > end_s:
                text = failure if isinstance(failure, str) else failure()
                raise ScanFailure(f"{text} within {timeout_s:g} s; check that the node runs")

    def _answer(self, future: Any, name: str) -> Any:
        self._wait(
            future.done, self._service_timeout_s, f"{name.split('/')[0]}: no answer of {name}"
        )
        return future.result()

    def _call(self, name: str, request: Any, patience_s: float | None = None) -> Any:
        """Answer of a service; asked again meanwhile unless ``patience_s`` is given.

        A server that has just discovered this node may not know yet where to send its answer.
        All requests but the one that takes patience may be carried out twice.
        """
        futures: list[Any] = []
        sent_s = -math.inf

        def answered() -> bool:
            nonlocal sent_s
            repeat = patience_s is None or not futures
            if repeat and time.monotonic() - sent_s > _RESEND_S:
                sent_s = time.monotonic()
                with self._living_context():
                    futures.append(self._clients[name].call_async(request))
            return any(future.done() for future in futures)

        timeout_s = patience_s or self._service_timeout_s
        self._wait(answered, timeout_s, f"{name.split('/')[0]}: no answer of {name}")
        return next(future.result() for future in futures if future.done())

    @contextlib.contextmanager
    def _living_context(self) -> Iterator[None]:
        """Turn the errors of a context that a signal has ended into a ``ScanFailure``."""
        try:
            yield
        except (_rclpy.RCLError, _rclpy.InvalidHandle) as error:
            raise ScanFailure(
                f"{self._node.get_name()}: the node was shut down: {error}"
            ) from error
