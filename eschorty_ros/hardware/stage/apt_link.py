"""Link to an APT controller: two threads, answers as futures, a stop that waits for nobody.

The reader hands every frame on as it comes; the writer sends what is queued and what is due
periodically. Both are loops around :meth:`AptLink.receive` and :meth:`AptLink.service`, which work
without threads, too, in whatever time ``now_ns`` tells.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from eschorty_ros.core.errors import DeviceError, DeviceGoneError, DeviceTimeoutError
from eschorty_ros.hardware.stage.apt_framer import AptFramer
from eschorty_ros.hardware.stage.apt_messages import Frame

_READ_S = 0.05
_STOP_LOCK_S = 0.01
_GONE_EXCEPTIONS = (OSError, TypeError, ValueError)

Wait = Callable[[threading.Condition, float], object]


class SerialPort(Protocol):
    """What the link uses of a pyserial port."""

    timeout: float | None

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""

    def read(self, size: int = 1) -> bytes:
        """Up to ``size`` bytes within ``timeout``."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def close(self) -> None:
        """Release the port."""


class _Timer:
    """Something the writer does every so often."""

    def __init__(self, period_ns: int, action: Callable[[], None], due_ns: int) -> None:
        self.period_ns, self.action, self.due_ns = period_ns, action, due_ns


def _port_failure(error: Exception) -> DeviceGoneError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return DeviceGoneError(
        f"the stage's port failed: {reason}; check the cable, then configure again"
    )


class AptLink:
    """Frames to and from one controller.

    Parameters
    ----------
    port : SerialPort
        Owned from here on.
    on_frame : callable
        Called for every frame with its time of receipt, in the reader's thread.
    on_lost : callable
        Called once when the port or a thread fails, with the reason.
    now_ns : callable
        Steady clock.
    wait : callable
        How to wait for an answer; without threads it has to make time pass.

    Attributes
    ----------
    framer : AptFramer
    stray_answers : int
        Answers nobody waited for any more.
    """

    def __init__(
        self,
        port: SerialPort,
        on_frame: Callable[[Frame, int], None],
        on_lost: Callable[[DeviceError], None],
        now_ns: Callable[[], int] = time.monotonic_ns,
        wait: Wait = threading.Condition.wait,
    ) -> None:
        self.framer = AptFramer()
        self.stray_answers = 0
        self.now_ns = now_ns
        self._port = port
        self._on_frame, self._on_lost = on_frame, on_lost
        self._wait_on = wait
        self._news = threading.Condition(threading.RLock())
        self._port_lock = threading.Lock()
        self._queue: deque[bytes] = deque()
        self._timers: list[_Timer] = []
        self._answers: dict[tuple[str, int], Future[Frame]] = {}
        self._lost: DeviceError | None = None
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Begin to read and write in threads."""
        for name, loop in (("apt reader", self._read_loop), ("apt writer", self._write_loop)):
            thread = threading.Thread(target=self._run, args=(loop,), name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def every(self, period_s: float, action: Callable[[], None]) -> None:
        """Have the writer call ``action`` every ``period_s``, for the first time now."""
        with self._news:
            self._timers.append(_Timer(round(period_s * 1e9), action, self.now_ns()))
            self._news.notify_all()

    def send(self, frame: bytes) -> None:
        """Queue a frame."""
        self._check()
        with self._news:
            self._queue.append(frame)
            self._news.notify_all()

    def send_now(self, *frames: bytes) -> None:
        """Write past every queue, in the caller's thread; on the wire when it returns.

        Tried even on a link that has failed: the controller may still hear a stop.

        Raises
        ------
        DeviceGoneError
            When the port fails or is closed.
        """
        self._check_open()
        # The writer holds the lock for one frame at most. Should it hang, two frames may mix:
        # better than no stop.
        held = self._port_lock.acquire(timeout=_STOP_LOCK_S)
        try:
            for frame in frames:
                self._port.write(frame)
        except _GONE_EXCEPTIONS as error:
            failure = _port_failure(error)
        else:
            return
        finally:
            if held:
                self._port_lock.release()
        self._fail(failure)
        raise failure

    def request(self, frame: bytes, answer: str, source: int, timeout_s: float) -> Frame:
        """Send ``frame`` and wait for the message ``answer`` from ``source``.

        Raises
        ------
        DeviceTimeoutError
            When it does not come in time.
        DeviceError
            When the link fails.
        """
        key = (answer, source)
        future: Future[Frame] = Future()
        with self._news:
            self._answers[key] = future
        try:
            self.send(frame)
            self.wait_until(future.done, timeout_s)
        finally:
            with self._news:
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
        """Wait for something that a frame brings; whether it holds."""
        end_ns = self.now_ns() + round(timeout_s * 1e9)
        with self._news:
            while not condition() and self._lost is None:
                left_ns = end_ns - self.now_ns()
                if left_ns <= 0:
                    break
                self._wait_on(self._news, left_ns * 1e-9)
        return condition()

    def receive(self, data: bytes) -> None:
        """Take bytes that have just come; without any, give up what stays incomplete."""
        now_ns = self.now_ns()
        for frame in self.framer.feed(data, now_ns):
            self._on_frame(frame, now_ns)
            with self._news:
                future = self._answers.pop((frame.name, frame.source), None)
                if future is not None:
                    future.set_result(frame)
                self._news.notify_all()

    def service(self) -> float:
        """Do what is due and send what is queued; seconds until something is due again."""
        now_ns = self.now_ns()
        for timer in self._timers:
            if timer.due_ns <= now_ns:
                # After a pause one call, not all that were missed.
                timer.due_ns = max(timer.due_ns + timer.period_ns, now_ns + timer.period_ns // 2)
                timer.action()
        while self._queue:
            self.write_at_once(self._queue.popleft())
        due_ns = min((timer.due_ns for timer in self._timers), default=now_ns + 10**9)
        return max(due_ns - self.now_ns(), 0) * 1e-9

    def write_at_once(self, frame: bytes) -> None:
        """Write a frame past the queue, from a timer's action or a frame's."""
        try:
            with self._port_lock:
                self._port.write(frame)
        except _GONE_EXCEPTIONS as error:
            # Without the lock: whoever is told may wait for one who waits for it.
            self._fail(_port_failure(error))

    def close(self) -> None:
        """End the threads and release the port; idempotent."""
        self._closing.set()
        with self._news:
            self._news.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=1.0)
        with contextlib.suppress(*_GONE_EXCEPTIONS):
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
        with self._news:
            self._news.notify_all()

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
            except _GONE_EXCEPTIONS as error:
                self._fail(_port_failure(error))
                return
            self.receive(data)

    def _write_loop(self) -> None:
        while not self._closing.is_set() and self._lost is None:
            idle_s = self.service()
            with self._news:
                if not self._queue and not self._closing.is_set():
                    self._news.wait(idle_s)
