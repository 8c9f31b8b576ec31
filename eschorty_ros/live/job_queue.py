"""A queue of jobs from several threads to one worker thread."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from eschorty_ros.core.base.errors import EschortyError

_POLL_S = 0.1
_JOBS_MAX = 200_000

Job = Callable[[], None]


class JobQueue:
    """Jobs in the order of their arrival, bounded: many small ones, fewer bulk jobs.

    - ``bulk_max``: Longest queue of bulk jobs.

    Public attributes:
    - ``overflows``: Jobs refused because the queue was full.
    """

    def __init__(self, bulk_max: int) -> None:
        self.overflows = 0
        self._bulk_max = bulk_max
        self._bulk = 0
        self._jobs: deque[tuple[Job, bool]] = deque()
        self._arrived = threading.Condition()

    def __len__(self) -> int:
        return len(self._jobs)

    def post(self, job: Job) -> bool:
        """Queue a small job; return ``False`` and count it when the queue is full."""
        return self._append(job, False)

    def post_later(self, job: Job) -> bool:
        """Queue a small job that need not end a wait for the next one."""
        return self._append(job, False, wakes=False)

    def post_bulk(self, job: Job) -> bool:
        """Queue a bulk job; return ``False`` and count it when the queue is full."""
        return self._append(job, True)

    def run(self, job: Job, timeout_s: float, running: Callable[[], bool]) -> tuple[bool, str]:
        """Queue a small job and wait for its end, at most while ``running()``.

        Returns whether it succeeded, and the reason of a failure. A job that has not begun within
        ``timeout_s`` never does; one of 0 is not waited for.
        """
        answered = threading.Event()
        refusal: list[str] = []
        # Taken once: by the worker that begins the job, or by the caller who gives up.
        turn = threading.Lock()

        def guarded() -> None:
            if not turn.acquire(blocking=False):
                return
            try:
                job()
            except EschortyError as error:
                refusal.append(str(error))
            except BaseException:
                refusal.append("internal error; see the node's log")
                raise
            finally:
                answered.set()

        if not self.post(guarded):
            return False, "the reconstruction has too much to do; send less"
        if timeout_s == 0.0:
            return True, ""
        end_s = time.monotonic() + timeout_s
        while not answered.wait(min(_POLL_S, timeout_s)):
            if not running() and turn.acquire(blocking=False):
                return False, "the node was shut down"
            if time.monotonic() > end_s and turn.acquire(blocking=False):
                return False, f"the reconstruction did not answer within {timeout_s:g} s"
        return not refusal, "".join(refusal)

    def next(self, timeout_s: float) -> Job | None:
        """Return the oldest job, ``None`` when none comes within ``timeout_s``."""
        with self._arrived:
            if not self._jobs and not self._arrived.wait_for(lambda: bool(self._jobs), timeout_s):
                return None
            job, bulk = self._jobs.popleft()
            self._bulk -= bulk
            return job

    def _append(self, job: Job, bulk: bool, wakes: bool = True) -> bool:
        with self._arrived:
            if (bulk and self._bulk >= self._bulk_max) or len(self._jobs) >= _JOBS_MAX:
                self.overflows += 1
                return False
            self._jobs.append((job, bulk))
            self._bulk += bulk
            if wakes:
                self._arrived.notify()
            return True
