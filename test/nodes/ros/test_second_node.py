"""Of two nodes of one name the second one refuses to start."""

import signal

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from ros_process import NodeProcess, Observer, wait_until

LASER, SCANNER = "eschorty_ros.nodes.laser.node", "eschorty_ros.nodes.scanner.node"
IDLE = {"auto_start": False}


def assert_refused(second: NodeProcess, name: str) -> None:
    assert second.wait() == 1, second.output
    [line] = [line for line in second.output.splitlines() if line.strip()]
    assert line.startswith(f"error: another node /eschorty/{name} runs")
    assert len(line) <= 300


def test_the_second_refuses_and_after_a_kill_the_next_starts(observer: Observer) -> None:
    with NodeProcess(LASER, IDLE, domain=observer.domain) as first:
        observer.wait_for_state("laser", "unconfigured")
        with NodeProcess(LASER, IDLE, domain=observer.domain) as second:
            assert_refused(second, "laser")
        assert first.running()
        first.send(signal.SIGKILL)
        first.wait()
    # The killed node is still in the graph of the others.
    with NodeProcess(LASER, IDLE, domain=observer.domain) as third:
        observer.wait_for_state("laser", "unconfigured")
        assert third.running()


def test_of_two_started_together_one_runs(observer: Observer) -> None:
    with (
        NodeProcess(SCANNER, {}, domain=observer.domain) as one,
        NodeProcess(SCANNER, {}, domain=observer.domain) as other,
    ):
        wait_until(lambda: not (one.running() and other.running()), "the end of one")
        ended, alive = (one, other) if other.running() else (other, one)
        assert_refused(ended, "scanner")
        observer.wait_for_answers("scanner")
        assert alive.running()
