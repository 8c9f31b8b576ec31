"""Tests of the nodes: without rclpy they are skipped, with it they share an observer."""

import pytest


def pytest_pycollect_makemodule() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")


@pytest.fixture
def observer():
    from ros_process import Observer

    with Observer() as made:
        yield made
