"""Executors: callbacks in threads, one at a time in a mutually exclusive group."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import rclpy.task
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import HistoryPolicy
from rclpy.subscription import Subscription
from rclpy.utilities import get_default_context

Work = Callable[[], None]

_TURN_S = 0.1
_PAUSE_S = 3e-4
_TAKEN_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class _InTurn:
    """Runs work in a pool's threads, one after the other in the order of submission."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._lock = threading.Lock()
        self._waiting: deque[Work] = deque()
        self._runs = False

    def submit(self, work: Work) -> None:
        with self._lock:
            self._waiting.append(work)
            if self._runs:
                return
            self._runs = True
        self._pool.submit(self._run)

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    self._runs = False
                    return
                work = self._waiting.popleft()
            work()


class EventExecutor(getattr(_rclpy, "EventsExecutor", object)):  # type: ignore[misc]
    """rclpy's ``EventsExecutor`` with the callback groups of ``MultiThreadedExecutor``.

    It waits for events instead of building a wait set at every turn, which costs a tenth. Its one
    thread takes messages, requests and timers; the callbacks run in ``threads`` threads.
    """

    def __init__(self, threads: int, context: Context) -> None:
        super().__init__(context)
        self._pool = ThreadPoolExecutor(threads, "callback")
        self._groups: dict[CallbackGroup, _InTurn] = {}
        self._members: list[Node] = []
        self._known: set[int] = set()
        self._error: Exception | None = None

    def add_node(self, node: Node) -> bool:
        """Add a node and redirect its callbacks to the threads."""
        if node not in self._members:
            self._members.append(node)
        self._redirect()
        return bool(super().add_node(node))

    def wake(self) -> None:
        """Take note of what a node has created."""
        self._redirect()
        super().wake()

    def create_task(self, callback: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Run a coroutine, which may wait, in a thread; anything else in the executor's."""
        if inspect.iscoroutinefunction(callback):
            return self._pool.submit(self._guarded, lambda: asyncio.run(callback(*args, **kwargs)))
        return super().create_task(callback, *args, **kwargs)

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop spinning; callbacks that still wait do not run."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        return bool(super().shutdown(timeout_sec))

    def raise_error(self) -> None:
        """Raise the first exception of a callback."""
        if self._error is not None:
            raise self._error

    def _redirect(self) -> None:
        for node in tuple(self._members):
            for entities, redirect in (
                (node.subscriptions, self._redirect_subscription),
                (node.timers, self._redirect_timer),
                (node.services, self._redirect_service),
            ):
                for entity in entities:
                    if not getattr(entity, "in_threads", False):
                        entity.in_threads = True
                        redirect(entity)

    def _submit(self, group: CallbackGroup, work: Work) -> None:
        guarded = partial(self._guarded, work)
        # A pool that has ended takes no more.
        with contextlib.suppress(RuntimeError):
            if isinstance(group, MutuallyExclusiveCallbackGroup):
                self._groups.setdefault(group, _InTurn(self._pool)).submit(guarded)
            else:
                self._pool.submit(guarded)

    def _guarded(self, work: Work) -> None:
        try:
            work()
        except Exception as error:
            self._error = self._error or error

    def _redirect_subscription(self, subscription: Subscription[Any]) -> None:
        callback, group = subscription.callback, subscription.callback_group
        profile = subscription.qos_profile
        bounded = profile.history == HistoryPolicy.KEEP_LAST and profile.depth > 0
        waiting: deque[Any] = deque(maxlen=profile.depth if bounded else None)

        def run() -> None:
            # A newer message may have taken its place.
            with contextlib.suppress(IndexError):
                message = waiting.popleft()
                callback(*message)

        def take(*message: Any) -> None:
            full = len(waiting) == waiting.maxlen
            # rclpy 9.1 gives message and information as one tuple.
            waiting.append(message[0] if isinstance(message[0], tuple) else message)
            if not full:
                self._submit(group, run)

        # The property would look at the signature again.
        subscription._callback = take

    def _redirect_timer(self, timer: Any) -> None:
        callback, group = timer.callback, timer.callback_group
        waits = threading.Lock()

        def run() -> None:
            waits.release()
            callback()

        def tick() -> None:
            if waits.acquire(blocking=False):
                self._submit(group, run)

        timer.callback = tick

    def _redirect_service(self, service: Any) -> None:
        callback, group, send = service.callback, service.callback_group, service.send_response

        def request(message: Any, response: Any) -> Future[Any]:
            answered: Future[Any] = Future()
            self._submit(group, lambda: answered.set_result(callback(message, response)))
            return answered

        def respond(answered: Future[Any], header: Any) -> None:
            answered.add_done_callback(lambda done: send(done.result(), header))

        service.callback, service.send_response = request, respond


class ThreadsExecutor(MultiThreadedExecutor):
    """rclpy's executor with threads, for distributions without ``EventsExecutor``."""

    def spin_until_future_complete(self, future: Any, timeout_sec: float | None = None) -> None:
        """Run callbacks; ``future`` wakes it only at the next of them."""
        with contextlib.suppress(ExternalShutdownException):
            self.spin_once(timeout_sec=timeout_sec)
            # While a callback runs, rclpy 9 polls for the next of its group without a pause and
            # would hold the interpreter's lock.
            time.sleep(_PAUSE_S)

    def raise_error(self) -> None:
        """Raise nothing: ``spin`` raises what a callback raises."""


class Spinning:
    """An executor that a thread spins, from ``start`` to ``end``."""

    def __init__(self, threads: int) -> None:
        available = hasattr(_rclpy, "EventsExecutor")
        make = EventExecutor if available else ThreadsExecutor
        # rclpy's executor takes these signals for itself.
        handlers = {number: signal.getsignal(number) for number in _TAKEN_SIGNALS}
        self.executor: Any = make(threads, context=get_default_context())
        for number, handler in handlers.items():
            signal.signal(number, handler)
        self._error: Exception | None = None
        self._ending = False
        self._thread = threading.Thread(target=self._spin, name="executor", daemon=True)

    def start(self) -> None:
        """Begin to run callbacks."""
        self._thread.start()

    def raise_error(self) -> None:
        """Raise the first exception of a callback."""
        if self._error is not None:
            raise self._error
        self.executor.raise_error()

    def end(self, timeout_s: float = 1.0) -> None:
        """Run no more callbacks; wait for the thread as long as that."""
        self._ending = True
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        # It would hold the interpreter's lock for as long as the thread spins.
        if not self._thread.is_alive():
            self.executor.shutdown(timeout_sec=timeout_s)

    def _spin(self) -> None:
        try:
            # Without a limit rclpy 9.1 spins its processor.
            while self.executor.context.ok() and not self._ending:
                self.executor.spin_until_future_complete(rclpy.task.Future(), _TURN_S)
        except Exception as error:
            if not self._ending:
                self._error = error
