"""When a node's heartbeat says that it stops; the looks are scripted, no ROS messages travel."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import DEADLINE_S

pytest.importorskip("rclpy", reason="rclpy is not installed")

from rclpy.clock import Clock

from eschorty_ros.control.peer import read_sign
from eschorty_ros.nodes.ros import heartbeat
from eschorty_ros.nodes.ros.heartbeat import RECOVERY_LOOKS, Heartbeat


class Script:
    """A node whose heartbeat looks so many times, and what it published."""

    def __init__(self, looks: int) -> None:
        self.stopped_at: list[int] = []
        self.look = 0
        self._looks = looks
        self._over = threading.Event()
        self.context = SimpleNamespace(ok=self._next)

    def _next(self) -> bool:
        self.look += 1
        if self.look > self._looks:
            self._over.set()
        return self.look <= self._looks

    def publish(self, message: Any) -> None:
        if read_sign(message.frame_id)[1]:
            self.stopped_at.append(self.look)

    def create_publisher(self, *_: object) -> Script:
        return self

    def get_clock(self) -> Any:
        return Clock()

    def run(self, healthy: Callable[[int], bool]) -> list[int]:
        """Let it beat; the looks at which it said that it stops."""
        Heartbeat(self, "stage/heartbeat", lambda: healthy(self.look))  # type: ignore[arg-type]
        assert self._over.wait(DEADLINE_S)
        return self.stopped_at


def pausing(monkeypatch: pytest.MonkeyPatch, at_look: int, pause_s: float) -> None:
    """Let the process itself have stood still before that look."""

    class Scripted:
        def __init__(self, period_s: float) -> None:
            self._looks = itertools.count(1)

        def look(self) -> float:
            return pause_s if next(self._looks) == at_look else 0.0

    monkeypatch.setattr(heartbeat, "OwnPauses", Scripted)


def test_a_device_that_fails_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pausing(monkeypatch, 0, 0.0)
    assert Script(20).run(lambda look: look < 10)[0] == 10


def test_a_device_not_heard_of_in_a_pause_of_the_process_gets_its_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pausing(monkeypatch, 10, 0.6)
    assert Script(40).run(lambda look: not 10 <= look < 10 + RECOVERY_LOOKS) == []


def test_a_device_that_is_not_heard_of_afterwards_either_has_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pausing(monkeypatch, 10, 0.6)
    assert Script(40).run(lambda look: look < 10)[0] == 10 + RECOVERY_LOOKS


def test_a_pause_revives_no_device_that_had_failed_before(monkeypatch: pytest.MonkeyPatch) -> None:
    pausing(monkeypatch, 15, 0.6)
    assert Script(30).run(lambda look: look < 10)[0] == 10
