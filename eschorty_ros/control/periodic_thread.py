"""A thread that looks at something again and again; no ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Lookout:
    """Calls ``look`` every ``period_s`` until ``end``; it ends with the first failure.

    Parameters
    ----------
    name : str
        Of the thread.
    look : callable
    period_s : float
    failed : callable
        Called in the thread with what ``look`` raised.
    """

    def __init__(
        self,
        name: str,
        look: Callable[[], None],
        period_s: float,
        failed: Callable[[Exception], None],
    ) -> None:
        self._look, self._period_s, self._failed = look, period_s, failed
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def end(self, patience_s: float) -> None:
        """Look no more; waits so long for a look under way."""
        self._ended.set()
        if self._thread is not threading.current_thread():
            self._thread.join(patience_s)

    def _run(self) -> None:
        try:
            while not self._ended.wait(self._period_s):
                self._look()
        except Exception as error:
            self._failed(error)
