"""Whatever breaks, the generator's own log says that the light went off within 250 ms.

The laser node runs with its real driver and guard on an emulated generator in a process of its
own; scanner, camera and stage are stand-ins that only beat.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy (ROS 2) is not installed")

from awg_process import AwgProcess, awg_process
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from eschorty_ros.msg import LaserState
from ros_process import NodeProcess, Observer, wait_until
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.nodes import qos
from eschorty_ros.nodes.domain import free_domain

OFF_LIMIT_S = 0.25
TEST_FOLDER = str(Path(__file__).parents[1])
BEATING = ("laser", "camera", "stage")


class Bench:
    """Generator, laser node and whoever has to be alive, each a process."""

    def __init__(self, awg: AwgProcess, observer: Observer, **parameters: Any) -> None:
        self.awg, self.observer = awg, observer
        self.node = self._process(
            "breakable_laser", {"driver": "awg", "backend": awg.backend, **parameters}
        )
        self.beating = {
            name: self._process("beating", {"topic": f"{name}/heartbeat"}) for name in BEATING
        }
        self.states = observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
        self.diagnostics = observer.collect(DiagnosticArray, "/diagnostics", qos.stream(100))
        self.breaking = observer.publisher(String, "test/break", qos.stream(10))
        self.interlock = observer.publisher(Bool, "laser/interlock", qos.stream(10))

    def _process(self, module: str, parameters: dict[str, Any]) -> NodeProcess:
        return NodeProcess(module, parameters, domain=self.observer.domain)

    def arm(self) -> Any:
        return self.observer.call(Trigger, "laser/arm")

    def enable(self, on: bool = True) -> Any:
        return self.observer.call(SetBool, "laser/enable", SetBool.Request(data=on))

    def light(self) -> None:
        """Switch on, once everybody is there."""
        self.observer.wait_for_state("laser", "active")

        def lit() -> bool:
            answers = self.arm(), self.enable()
            print(*(answer.message for answer in answers))
            return all(answer.success for answer in answers)

        wait_until(lit, "light", deadline_s=10.0, poll_s=0.2)
        assert self.awg.lit()
        time.sleep(0.3)
        assert self.awg.lit()

    def dark_after(self, cause: str, since_ns: int) -> None:
        took_s = self.awg.off_after_s(since_ns)
        print(f"{cause}: dark after {took_s * 1e3:.1f} ms")
        assert took_s < OFF_LIMIT_S

    def close(self) -> None:
        for process in (*self.beating.values(), self.node):
            print(f"--- {process.module}\n{process.output}")
            process.kill()


@pytest.fixture
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{TEST_FOLDER}:{os.environ.get('PYTHONPATH', '')}")


@pytest.fixture
def awg(tmp_path: Path) -> Iterator[AwgProcess]:
    with awg_process(tmp_path) as made:
        yield made


@pytest.fixture
def observer() -> Iterator[Observer]:
    with Observer(free_domain(), "safety_observer") as made:
        yield made


@pytest.fixture
def bench(importable: None, awg: AwgProcess, observer: Observer) -> Iterator[Bench]:
    made = Bench(awg, observer)
    try:
        made.light()
        yield made
    finally:
        made.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM, signal.SIGINT])
def test_signal_to_the_laser_node(bench: Bench, number: int) -> None:
    sent_ns = time.monotonic_ns()
    bench.node.send(number)
    bench.dark_after(signal.Signals(number).name, sent_ns)
    if number == signal.SIGSTOP:
        bench.node.send(signal.SIGCONT)
        wait_until(lambda: "is stopped" in bench.states[-1].reason, "the reason in laser/state")
        assert not bench.enable().success


@pytest.mark.parametrize("way", ["exception", "abort", "segfault"])
def test_laser_node_that_breaks_by_itself(bench: Bench, way: str) -> None:
    sent_ns = time.monotonic_ns()
    bench.breaking.publish(String(data=way))
    bench.dark_after(way, sent_ns)
    assert bench.node.wait() != 0


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("name", BEATING)
def test_whoever_light_depends_on_dies(bench: Bench, name: str, number: int) -> None:
    sent_ns = time.monotonic_ns()
    bench.beating[name].send(number)
    bench.dark_after(f"{name} {signal.Signals(number).name}", sent_ns)
    wait_until(lambda: f"{name}/heartbeat" in bench.states[-1].reason, "the reason")
    assert bench.states[-1].output == LaserState.OUTPUT_OFF


def test_guard_dies(bench: Bench) -> None:
    guard = _child(bench.node.pid, "eschorty_ros.hardware.laser.guard")
    sent_ns = time.monotonic_ns()
    os.kill(guard, signal.SIGKILL)
    bench.dark_after("guard SIGKILL", sent_ns)
    bench.observer.wait_for_state("laser", "unconfigured")
    assert bench.observer.change_state("laser", "configure")
    assert bench.observer.change_state("laser", "activate")
    bench.light()


def test_interlock_opens(bench: Bench) -> None:
    sent_ns = time.monotonic_ns()
    bench.interlock.publish(Bool(data=True))
    bench.dark_after("interlock", sent_ns)


def test_fault_u1_unplug_of_the_generator(bench: Bench) -> None:
    """driver: alarm, guard tries for 30 s, off at once on replug; user reads: laser state unknown"""
    bench.awg.do("gone")
    wait_until(lambda: bench.states[-1].output == LaserState.OUTPUT_UNKNOWN, "unknown")
    assert bench.awg.lit()

    def alarm() -> bool:
        status = [s for a in bench.diagnostics for s in a.status if s.name.endswith("laser")]
        return status[-1].level == DiagnosticStatus.ERROR and "unknown" in status[-1].message

    wait_until(alarm, "the alarm in /diagnostics")
    bench.observer.wait_for_state("laser", "unconfigured")
    plugged_ns = time.monotonic_ns()
    bench.awg.do("back")
    took_s = bench.awg.off_after_s(plugged_ns)
    print(f"dark {took_s:.2f} s after it was plugged in")
    assert took_s < 2.0


def test_fault_u8_panel_touched_while_lit(bench: Bench) -> None:
    """driver: reads back twice a second or more and switches off; user reads: what differs"""
    bench.awg.do("touch BASE:FREQuency 90")
    wait_until(lambda: not bench.awg.lit(), "dark")
    wait_until(lambda: "90" in bench.states[-1].reason, "the reason in laser/state")


def test_fault_u9_generator_restarted(bench: Bench) -> None:
    """driver: takes note that it is dark, refuses light until configured; user reads: found off"""
    bench.awg.do("reboot")
    assert not bench.awg.lit()
    wait_until(lambda: bench.states[-1].output == LaserState.OUTPUT_OFF, "off in laser/state")
    wait_until(lambda: bench.states[-1].requested == LaserState.OUTPUT_OFF, "no longer asked for")


def test_interlock_that_is_required_is_open_until_it_says_closed(
    importable: None, awg: AwgProcess, observer: Observer
) -> None:
    bench = Bench(awg, observer, interlock_required=True)
    try:
        observer.wait_for_state("laser", "active")
        wait_until(lambda: bench.states and bench.states[-1].interlock_open, "the interlock open")
        assert "interlock open" in bench.arm().message
        bench.interlock.publish(Bool(data=False))
        wait_until(lambda: not bench.states[-1].interlock_open, "the interlock closed")
        bench.light()
    finally:
        bench.close()


def test_watched_node_that_never_came_is_named(
    importable: None, awg: AwgProcess, observer: Observer
) -> None:
    bench = Bench(awg, observer)
    try:
        observer.wait_for_state("laser", "active")
        bench.beating["camera"].kill()
        time.sleep(0.3)
        assert bench.arm().success
        refused = bench.enable()
        assert not refused.success
        assert "camera" in refused.message
        assert "ON" not in awg.outputs()
    finally:
        bench.close()


def _child(pid: int, module: str) -> int:
    """Process started by ``pid`` that runs ``module``."""
    for number in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        if module in Path(f"/proc/{number}/cmdline").read_text():
            return int(number)
    for path in Path("/proc").glob("[0-9]*"):
        with_parent = f"\nPPid:\t{pid}\n"
        if with_parent in (path / "status").read_text() and module in (
            path / "cmdline"
        ).read_text():
            return int(path.name)
    raise AssertionError("no guard")
