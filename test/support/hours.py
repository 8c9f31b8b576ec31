"""A steady clock that a test sets, for a loop that measures its own pauses."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest
from waiting import wait_until

from eschorty_ros.hardware.base import stalls as own_pauses


class Hours:
    """What the loop's pauses and its other times are measured by."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._now_s = time.monotonic()
        self._looks = 0
        monkeypatch.setattr(own_pauses, "time", SimpleNamespace(monotonic=self._look))

    def monotonic(self) -> float:
        return self._now_s

    def _look(self) -> float:
        self._looks += 1
        return self._now_s

    def pass_by(self, seconds: float) -> None:
        """Let the time pass at once, and the loop take two whole turns after it."""
        self._now_s += seconds
        seen = self._looks
        wait_until(lambda: self._looks >= seen + 3, "two turns", poll_s=0.005)
