"""Jobs handed from the executor's threads to one worker thread, in order."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

Job = Callable[[], None]


class Mailbox:
    """A queue in which bulk jobs are bounded and small ones always get through.

    Parameters
    ----------
    bulk_max : int
        Bulk jobs that may wait.

    Attributes
    ----------
    overflows : int
        Bulk jobs refused because the queue was full.
    """

    def __init__(self, bulk_max: int) -> None:
        self.overflows = 0
        self._bulk_max = bulk_max
        self._bulk = 0
        self._jobs: deque[tuple[Job, bool]] = deque()
        self._arrived = threading.Condition()

    def __len__(self) -> int:
        return len(self._jobs)

    def post(self, job: Job) -> None:
        """Queue a small job."""
        self._append(job, False)

    def post_bulk(self, job: Job) -> bool:
        """Queue a bulk job; ``False`` and counted when the queue is full."""
        return self._append(job, True)

    def take(self, timeout_s: float) -> Job | None:
        """Return the oldest job, ``None`` when none comes within ``timeout_s``."""
        with self._arrived:
            if not self._jobs and not self._arrived.wait_for(lambda: bool(self._jobs), timeout_s):
                return None
            job, bulk = self._jobs.popleft()
            self._bulk -= bulk
            return job

    def _append(self, job: Job, bulk: bool) -> bool:
        with self._arrived:
            if bulk and self._bulk >= self._bulk_max:
                self.overflows += 1
                return False
            self._jobs.append((job, bulk))
            self._bulk += bulk
            self._arrived.notify()
            return True
