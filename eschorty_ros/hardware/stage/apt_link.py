"""Link to an APT controller: two threads, answers as futures, a stop that passes every queue.

The reader thread loops around :meth:`AptLink.receive`, the writer thread around
:meth:`AptLink.service`. Tests call both without threads, in the time of their own ``now_ns``.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError, DeviceTimeoutError
from eschorty_ros.hardware.stage.apt_framer import AptFramer
from eschorty_ros.hardware.stage.apt_messages import Frame

_READ_S = 0.2
_STOP_LOCK_S = 0.01
_PORT_ERRORS = (OSError, TypeError, ValueError)


class SerialPort(Protocol):
    """The part of a pyserial port that the link uses."""

    timeout: float | None

    @property
    def in_waiting(self) -> int:
        """Return the number of bytes that can be read at once."""

    def read(self, size: int = 1) -> bytes:
        """Return up to ``size`` bytes within ``timeout``."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def close(self) -> None:
        """Release the port."""


class _Timer:
    """A periodic action of the writer."""

    def __init__(
        self, period_s: Callable[[], float], action: Callable[[], None], due_ns: int
    ) -> None:
        self.period_s, self.action, self.due_ns = period_s, action, due_ns


def _port_failure(error: Exception) -> DeviceGoneError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return DeviceGoneError(
        f"the stage's port failed: {reason}; check the cable, then configure again"
    )


class AptLink:
    """Frames to and from one controller.

    - ``port``: Owned from here on.
    - ``on_frame``: Called for every frame with its time of receipt, in the reader's thread.
    - ``on_lost``: Called once when the port or a thread fails, with the reason.
    - ``now_ns``: Steady clock.
    - ``wait``: Waits for an answer; without threads it has to advance the time.
    """

    def __init__(
        self,
        port: SerialPort,
        on_frame: Callable[[Frame, int], None],
        on_lost: Callable[[DeviceError], None],
        now_ns: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[threading.Condition, float], object] = threading.Condition.wait,
    ) -> None:
        self.framer = AptFramer()
        self.now_ns = now_ns
        self._port = port
        self._on_frame, self._on_lost = on_frame, on_lost
        self._wait = wait
        lock = threading.RLock()
        self._changed = threading.Condition(lock)
        # Frames that come need not wake the writer.
        self._queued = threading.Condition(lock)
        self._port_lock = threading.Lock()
        self._queue: deque[bytes] = deque()
        self._timers: list[_Timer] = []
        self._answers: dict[tuple[str, int], Future[Frame]] = {}
        self._lost: DeviceError | None = None
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Start the threads that read and write."""
        for name, loop in (("apt reader", self._read_loop), ("apt writer", self._write_loop)):
            thread = threading.Thread(target=self._run, args=(loop,), name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def call_every(self, period_s: Callable[[], float], action: Callable[[], None]) -> None:
        """Let the writer call ``action`` at once and then every ``period_s()``."""
        with self._queued:
            self._timers.append(_Timer(period_s, action, self.now_ns()))
            self._queued.notify_all()

    def send(self, frame: bytes) -> None:
        """Queue a frame."""
        self._check()
        with self._queued:
            self._queue.append(frame)
            self._queued.notify_all()

    def send_now(self, *frames: bytes) -> None:
        """Write past every queue, in the caller's thread; on the wire when it returns.

        Tried even on a link that has failed: the controller may still obey a stop.

        Raises ``DeviceGoneError`` when the port fails or is closed.
        """
        self._check_open()
        # The writer holds the lock for one frame at most. If it hangs, two frames may mix, which is
        # better than no stop.
        held = self._port_lock.acquire(timeout=_STOP_LOCK_S)
        try:
            for frame in frames:
                self._port.write(frame)
        except _PORT_ERRORS as error:
            failure = _port_failure(error)
        else:
            return
        finally:
            if held:
                self._port_lock.release()
        self._fail(failure)
        raise failure

    def write(self, frame: bytes) -> None:
        """Write a frame past the queue, from a timer's action or while a frame is handled."""
        try:
            with self._port_lock:
                self._port.write(frame)
        except _PORT_ERRORS as error:
            # Without the lock: ``on_lost`` may wait for a thread that waits for it.
            self._fail(_port_failure(error))

    def request(self, frame: bytes, answer: str, source: int, timeout_s: float) -> Frame:
        """Send ``frame`` and return the message ``answer`` from ``source``.

        Raises ``DeviceTimeoutError`` when it does not come in time. Raises ``DeviceError`` when the
        link fails.
        """
        key = (answer, source)
        future: Future[Frame] = Future()
        with self._changed:
            self._answers[key] = future
        try:
            self.send(frame)
            self.wait_until(future.done, timeout_s)
        finally:
            with self._changed:
                if self._answers.get(key) is future:
                    del self._answers[key]
        if future.done():
            return future.result()
        self._check()
        raise DeviceTimeoutError(
            f"the stage controller sent no {answer!r} within {timeout_s:g} s; "
            "check its power, the cable and the parameter controller"
        )

    def wait_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for a condition that frames bring about; return whether it holds."""
        end_ns = self.now_ns() + round(timeout_s * 1e9)
        with self._changed:
            while not condition() and self._lost is None:
                left_ns = end_ns - self.now_ns()
                if left_ns <= 0:
                    break
                self._wait(self._changed, left_ns * 1e-9)
        return condition()

    def receive(self, data: bytes) -> None:
        """Handle bytes just received; with none, drop a frame that stays incomplete."""
        now_ns = self.now_ns()
        for frame in self.framer.feed(data, now_ns):
            self._on_frame(frame, now_ns)
            with self._changed:
                future = self._answers.pop((frame.name, frame.source), None)
                if future is not None:
                    future.set_result(frame)
                self._changed.notify_all()

    def service(self) -> float:
        """Do what is due, send what is queued; return the time to the next action (s)."""
        now_ns = self.now_ns()
        for timer in self._timers:
            if timer.due_ns <= now_ns:
                # After a stall one call, not all that were missed.
                period_ns = round(timer.period_s() * 1e9)
                timer.due_ns = max(timer.due_ns + period_ns, now_ns + period_ns // 2)
                timer.action()
        while self._queue:
            self.write(self._queue.popleft())
        return self._idle_s()

    def close(self) -> None:
        """End the threads and release the port; idempotent."""
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
            self._queued.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=1.0)
        with contextlib.suppress(*_PORT_ERRORS):
            self._port.close()

    def _check(self) -> None:
        if self._lost is not None:
            raise self._lost
        self._check_open()

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise DeviceGoneError("the stage's port is closed; open the stage again")

    def _fail(self, failure: DeviceError) -> None:
        if self._lost is not None or self._closing.is_set():
            return
        self._lost = failure
        self._on_lost(failure)
        with self._changed:
            self._changed.notify_all()
            self._queued.notify_all()

    def _run(self, loop: Callable[[], None]) -> None:
        try:
            loop()
        except Exception as error:
            text = " ".join(repr(error).split())
            self._fail(DeviceError(f"the stage's driver failed: {text}; configure again"))
            raise

    def _read_loop(self) -> None:
        port = self._port
        port.timeout = _READ_S
        while not self._closing.is_set() and self._lost is None:
            try:
                data = port.read(1)
                if data:
                    data += port.read(port.in_waiting)
            except _PORT_ERRORS as error:
                self._fail(_port_failure(error))
                return
            self.receive(data)

    def _write_loop(self) -> None:
        while not self._closing.is_set() and self._lost is None:
            self.service()
            with self._queued:
                # What was added since wakes a writer that waits, and this one does not yet.
                if not self._queue and not self._closing.is_set() and self._lost is None:
                    self._queued.wait(self._idle_s())

    def _idle_s(self) -> float:
        """Return the time to the next action."""
        now_ns = self.now_ns()
        due_ns = min((timer.due_ns for timer in self._timers), default=now_ns + 10**9)
        return max(due_ns - now_ns, 0) * 1e-9
