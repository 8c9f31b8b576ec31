"""Executors that outlast errors, with callbacks in threads by callback group."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import rclpy.task
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import HistoryPolicy
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.utilities import get_default_context

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.nodes.ros.border import note_error

Work = Callable[[], None]
_Events: Any = getattr(_rclpy, "EventsExecutor", object)

_TURN_S = 1.0
_TASKS_S = 0.02
_POLL_S = 0.1
_PAUSE_S = 3e-4
_LINE_MAX = 300
_LOG_S = 5.0
_TAKEN_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class ShortGroup(MutuallyExclusiveCallbackGroup):
    """Short callbacks that wait for nothing: they run in the executor's own thread.

    Each then costs one change of threads less.
    """


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


class _Redirecting:
    """Redirects the callbacks of an executor's nodes, also of what they create later.

    An exception of a callback is counted and logged, and the node goes on. An ``EschortyError``
    that a timer raises ends the process; nodes end on purpose in this way.
    """

    def __init__(self) -> None:
        self._members: list[Node] = []
        self.error: Exception | None = None
        self.ending = False

    def add_node(self, node: Node) -> bool:
        """Add a node."""
        if node not in self._members:
            self._members.append(node)
        self._redirect()
        return bool(super().add_node(node))  # type: ignore[misc]

    def wake(self) -> None:
        """Take note of what a node has created."""
        self._redirect()
        super().wake()  # type: ignore[misc]

    def _redirect(self) -> None:
        for node in tuple(self._members):
            for entities, redirect in (
                (node.subscriptions, self._redirect_subscription),
                (node.timers, self._redirect_timer),
                (node.services, self._redirect_service),
                (node.waitables, self._redirect_waitable),
            ):
                for entity in entities:
                    if not hasattr(entity, "redirected"):
                        entity.redirected = True
                        redirect(node, entity)

    def _guarded(self, node: Node, entity: Any, work: Work) -> Work:
        def guarded() -> None:
            if self.ending:
                return
            try:
                work()
            except Exception as error:
                if isinstance(entity, Timer) and isinstance(error, EschortyError):
                    self.error = self.error or error
                elif not self.ending:
                    note_error(node, entity, error)

        return guarded

    def _submit(self, group: CallbackGroup, work: Work) -> None:
        """Run work of a callback group."""
        raise NotImplementedError

    def _redirect_subscription(self, node: Node, subscription: Subscription[Any]) -> None:
        callback, profile = subscription.callback, subscription.qos_profile
        bounded = profile.history == HistoryPolicy.KEEP_LAST and profile.depth > 0
        waiting: deque[tuple[Any, ...]] = deque(maxlen=profile.depth if bounded else None)
        lock = threading.Lock()

        def take_first() -> None:
            with lock:
                message = waiting.popleft()
            callback(*message)

        run = self._guarded(node, subscription, take_first)

        def receive(*message: Any) -> None:
            # Each message that waits has one run, which a newer one inherits that takes its place.
            with lock:
                full = len(waiting) == waiting.maxlen
                # rclpy 9.1's EventsExecutor gives message and information as one tuple.
                waiting.append(message[0] if isinstance(message[0], tuple) else message)
            if not full:
                self._submit(subscription.callback_group, run)

        # The property would look at the signature again.
        subscription._callback = receive

    def _redirect_timer(self, node: Node, timer: Any) -> None:
        callback, running = timer.callback, threading.Lock()

        def tick() -> None:
            try:
                # It may have expired once more before its last run canceled it.
                if not timer.is_canceled():
                    callback()
            finally:
                running.release()

        run = self._guarded(node, timer, tick)

        def expire() -> None:
            if running.acquire(blocking=False):
                self._submit(timer.callback_group, run)

        timer.callback = expire

    def _redirect_service(self, node: Node, service: Any) -> None:
        callback, send = service.callback, service.send_response

        def request(message: Any, response: Any) -> Future[Any]:
            answered: Future[Any] = Future()

            def answer() -> None:
                try:
                    answered.set_result(callback(message, response))
                except Exception as error:
                    if hasattr(response, "message"):
                        response.message = str(error)[:_LINE_MAX]
                    answered.set_result(response)
                    raise

            self._submit(service.callback_group, self._guarded(node, service, answer))
            return answered

        def respond(answered: Future[Any], header: Any) -> None:
            response = self._guarded(node, service, lambda: send(answered.result(), header))
            answered.add_done_callback(lambda _: response())

        service.callback, service.send_response = request, respond

    def _redirect_waitable(self, node: Node, waitable: Any) -> None:
        execute = waitable.execute

        async def executed(data: Any) -> None:
            # Such as an action whose client does not take the answer.
            try:
                await execute(data)
            except Exception as error:
                if not self.ending:
                    note_error(node, waitable, error)

        waitable.execute = executed


def _add_thread(threads: list[threading.Thread]) -> None:
    threads.append(threading.current_thread())


class EventExecutor(_Redirecting, _Events):
    """rclpy's ``EventsExecutor`` with the callback groups of ``MultiThreadedExecutor``.

    It waits for events instead of building a wait set at every turn, which is what costs there.
    Its one thread takes messages, requests and timers; callbacks run in ``threads`` threads.
    """

    def __init__(self, threads: int, context: Context) -> None:
        _Redirecting.__init__(self)
        _Events.__init__(self, context)
        self._threads: list[threading.Thread] = []
        # No method of its own: in a cycle of references it would outlive its nodes.
        self._pool = ThreadPoolExecutor(threads, "callback", _add_thread, (self._threads,))
        self._groups: dict[CallbackGroup, _InTurn] = {}

    def create_task(self, callback: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Run a coroutine, which may wait, in a thread; anything else in the executor's."""
        if inspect.iscoroutinefunction(callback):
            return self._pool.submit(lambda: asyncio.run(callback(*args, **kwargs)))

        def called() -> Any:
            # An exception would end the process: rclpy 9.1 looks for a logger at a null pointer.
            try:
                return callback(*args, **kwargs)
            except Exception as error:
                for node in self._members[: not self.ending]:
                    note_error(node, callback, error)

        return super().create_task(called)

    def end_callbacks(self) -> bool:
        """Let callbacks that still wait not run; return whether one is running."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        return any(thread.is_alive() for thread in self._threads)

    def _submit(self, group: CallbackGroup, work: Work) -> None:
        if isinstance(group, ShortGroup):
            work()
            return
        # A pool that has ended takes no more.
        with contextlib.suppress(RuntimeError):
            if isinstance(group, MutuallyExclusiveCallbackGroup):
                self._groups.setdefault(group, _InTurn(self._pool)).submit(work)
            else:
                self._pool.submit(work)


class ThreadsExecutor(_Redirecting, MultiThreadedExecutor):
    """rclpy's executor with threads, for distributions without ``EventsExecutor``."""

    def __init__(self, threads: int, context: Context) -> None:
        _Redirecting.__init__(self)
        MultiThreadedExecutor.__init__(self, threads, context=context)

    def spin_until_future_complete(self, future: Any, timeout_sec: float | None = None) -> None:
        """Run callbacks for a while; ``future`` is not looked at."""
        with contextlib.suppress(ExternalShutdownException):
            self.spin_once(timeout_sec=_POLL_S)
            # While a callback runs, rclpy 9 polls for the next of its group without a pause and
            # would hold the interpreter's lock.
            time.sleep(_PAUSE_S)

    def end_callbacks(self) -> bool:
        """Return that none is running: the executor's own shutdown waits for them."""
        return False

    def _submit(self, group: CallbackGroup, work: Work) -> None:
        work()


class Spinning:
    """An executor that a thread spins, from ``start`` to ``end``.

    - ``threads``: Threads that run callbacks.
    - ``context``: The default one when omitted.
    """

    def __init__(self, threads: int, context: Context | None = None) -> None:
        make = ThreadsExecutor if _Events is object else EventExecutor
        # rclpy's executor takes these signals for itself; only a main thread can take them back.
        main = threading.current_thread() is threading.main_thread()
        taken = _TAKEN_SIGNALS if main else ()
        handlers = {number: signal.getsignal(number) for number in taken}
        self.executor: Any = make(threads, context=context or get_default_context())
        for number, handler in handlers.items():
            signal.signal(number, handler)
        self._turn = rclpy.task.Future()
        self._thread = threading.Thread(target=self._spin, name="executor", daemon=True)

    def start(self) -> None:
        """Begin to run callbacks."""
        self._thread.start()

    def raise_error(self) -> None:
        """Raise the error by which a node ends."""
        if self.executor.error is not None:
            raise self.executor.error

    def stop_callbacks(self) -> None:
        """Begin no more callbacks."""
        self.executor.ending = True

    def end(self, timeout_s: float = 1.0) -> None:
        """Begin no more callbacks, wait for the thread as long as that, drop the executor."""
        self.stop_callbacks()
        self._turn.set_result(None)
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        # It would hold the interpreter's lock for as long as the thread spins.
        if not self._thread.is_alive():
            # Tasks that never run would keep their nodes, also those that the last callbacks begin,
            # and so does the executor itself. Requests that still come, such as a cancel, meet
            # servers that have ended.
            end_s, running = time.monotonic() + timeout_s, True
            while running and time.monotonic() < end_s:
                running = self.executor.end_callbacks()
                with contextlib.suppress(Exception):
                    self.executor.spin_until_future_complete(rclpy.task.Future(), _TASKS_S)
            self.executor.shutdown(timeout_sec=timeout_s)
            self.executor = None

    def _spin(self) -> None:
        # Without a limit rclpy 9.1's EventsExecutor never waits.
        while self.executor.context.ok():
            self._turn = rclpy.task.Future()
            if self.executor.ending:
                return
            try:
                self.executor.spin_until_future_complete(self._turn, _TURN_S)
            except ExternalShutdownException:
                return
            except Exception as error:
                # Such as a message that cannot be read.
                text = f"{error!r}"[:_LINE_MAX]
                if not self.executor.ending:
                    get_logger("executor").error(text, throttle_duration_sec=_LOG_S)
