"""A steady clock that a test sets, for a loop that measures its own stalls."""

import time
from types import SimpleNamespace

import pytest
from waiting import wait_until

from eschorty_ros.hardware.base import stalls


class StallClock:
    """The clock of a loop's stall meter and, through ``monotonic``, of its ages."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._now_s = time.monotonic()
        self._turns = 0
        monkeypatch.setattr(stalls, "time", SimpleNamespace(monotonic=self._measured))

    def monotonic(self) -> float:
        return self._now_s

    def _measured(self) -> float:
        self._turns += 1
        return self._now_s

    def advance(self, seconds: float) -> None:
        """Let the time pass at once, and the loop take two full turns after it."""
        self._now_s += seconds
        before = self._turns
        wait_until(lambda: self._turns >= before + 3, "two turns", poll_s=0.005)
