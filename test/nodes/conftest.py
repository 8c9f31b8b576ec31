"""Tests of the nodes: without rclpy they are skipped, with it they share an observer."""

import pytest


def pytest_pycollect_makemodule() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(call):
    """Add the end of each node's output to the report of a test that fails."""
    report = yield
    from ros_process import NodeProcess

    if report.failed:
        report.sections += [(node.module, node.end_of_output) for node in NodeProcess.known]
    if call.when == "teardown":
        NodeProcess.known = [node for node in NodeProcess.known if node.running()]
    return report


@pytest.fixture
def observer():
    from ros_process import Observer

    with Observer() as made:
        yield made
