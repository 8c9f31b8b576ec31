"""Stalls of this process are measured by how late the turns of a loop are."""

from types import SimpleNamespace

import pytest

from eschorty_ros.hardware.base import stalls
from eschorty_ros.hardware.base.stalls import StallMeter


def test_only_the_delay_of_a_turn_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    now = {"s": 50.0}
    monkeypatch.setattr(stalls, "time", SimpleNamespace(monotonic=lambda: now["s"]))
    meter = StallMeter()
    for step_s, late_s in [(0.02, 0.0), (0.1, 0.0), (1.32, 1.3), (0.02, 0.0), (0.22, 0.2)]:
        now["s"] += step_s
        assert meter.measure(0.02) == pytest.approx(late_s)
