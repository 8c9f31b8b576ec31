"""Real drivers without devices: each node reports what it waits for, and ends normally."""

import signal
import time
from collections.abc import Iterator

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros_process import NodeProcess, Observer, processes, wait_until

from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.lifecycle import RETRY_S

NODES = "eschorty_ros.nodes.{}.node"
# An empty bus instead of this host's, which may have a camera or a generator.
EMPTY = "eschorty_ros.emulation.bus.usb_remote:backend?/nonexistent/usb.sock"
DEVICES = {
    NODES.format("camera"): {"driver": "evk4", "backend": EMPTY},
    NODES.format("laser"): {"driver": "awg", "backend": EMPTY},
    NODES.format("stage"): {"driver": "apt", "serial": "no such controller"},
}
SCANNER = {NODES.format("reconstruction"): {}, NODES.format("scanner"): {"auto_scan": True}}


@pytest.fixture(scope="module")
def observer() -> Iterator[Observer]:
    with Observer() as observer:
        yield observer


@pytest.fixture(scope="module")
def running(observer: Observer) -> Iterator[dict[str, NodeProcess]]:
    with processes({**DEVICES, **SCANNER}, observer.domain) as running:
        yield running


def test_every_node_reports_what_it_waits_for(
    observer: Observer, running: dict[str, NodeProcess]
) -> None:
    reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream(100))
    waiting = ("camera", "laser", "stage", "scanner")

    def reported() -> dict[str, DiagnosticStatus]:
        newest = {s.name.rsplit("/", 1)[-1]: s for array in reports for s in array.status}
        return {name: newest[name] for name in waiting if name in newest}

    wait_until(
        lambda: (
            len(reported()) == len(waiting)
            and all(status.message.startswith("waiting: ") for status in reported().values())
        ),
        "every node waiting",
    )
    for name, status in reported().items():
        print(f"{name}: {status.message}")
        assert status.level == DiagnosticStatus.WARN
        assert "\n" not in status.message
    for name in ("camera", "laser", "stage"):
        assert f"trying again every {RETRY_S:g} s" in reported()[name].message
        assert observer.lifecycle_state(name) == "unconfigured"


def test_the_reason_is_logged_once(running: dict[str, NodeProcess]) -> None:
    time.sleep(2.5 * RETRY_S)
    for name in ("camera", "laser", "stage"):
        lines = [line for line in running[name].output.splitlines() if "waiting: " in line]
        assert len(lines) == 1, running[name].output


def test_ctrl_c_ends_all_with_exit_code_0(running: dict[str, NodeProcess]) -> None:
    for process in running.values():
        process.send(signal.SIGINT)
    codes = {name: process.wait() for name, process in running.items()}
    assert set(codes.values()) == {0}, codes
    for name, process in running.items():
        assert "Traceback" not in process.output, f"{name}: {process.output}"
        assert "rror" not in process.output, f"{name}: {process.output}"
