"""Emulated devices for nodes and tests: a laser, a stage and a camera that sees both."""

from __future__ import annotations

from eschorty_ros.simulation.fake_camera import FakeCamera
from eschorty_ros.simulation.fake_laser import FakeLaser
from eschorty_ros.simulation.fake_stage import FakeStage

__all__ = ["FakeCamera", "FakeLaser", "FakeStage"]
