"""Time in which the process itself stood still is told from time in which others are silent."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from eschorty_ros.hardware.base import stalls as own_pauses
from eschorty_ros.hardware.base.stalls import OwnPauses


def test_only_what_a_look_is_late_by_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    now = {"s": 50.0}
    monkeypatch.setattr(own_pauses, "time", SimpleNamespace(monotonic=lambda: now["s"]))
    pauses = OwnPauses(0.02)
    for step_s, late_s in [(0.02, 0.0), (0.1, 0.0), (1.32, 1.3), (0.02, 0.0), (0.22, 0.2)]:
        now["s"] += step_s
        assert pauses.look() == pytest.approx(late_s)
