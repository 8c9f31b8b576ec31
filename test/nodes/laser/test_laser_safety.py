"""Whatever fails, the generator's own log shows the output off within 250 ms.

Scanner, camera and stage are processes that only send heartbeats.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from eschorty_ros.msg import LaserState
from laser_bench import OFF_LIMIT_S, LaserBench
from ros_process import NodeProcess, wait_until
from std_msgs.msg import Bool, String

from eschorty_ros.nodes.ros import qos

SENDERS = ("laser", "camera", "stage")
WAYS_TO_ACTIVE = {"unconfigured": "configure", "inactive": "activate"}
# Every fault here has to be noticed at once, without a timeout; and no timeout may end the light
# when a loaded machine delays the senders.
TIMEOUTS = {f"{name}_timeout": 60.0 for name in ("heartbeat", "camera", "stage")}


class Bench(LaserBench):
    """A laser node that can be broken, with the processes that send it heartbeats."""

    def __init__(
        self, held: contextlib.ExitStack, folder: Path, senders: tuple[str, ...], **parameters: Any
    ) -> None:
        super().__init__(held, folder, "breakable_laser", **TIMEOUTS, **parameters)
        self._names = senders
        self._senders: dict[str, NodeProcess] = {}
        self.start_senders()
        self.diagnostics = self.observer.collect(DiagnosticArray, "/diagnostics", qos.stream(100))
        self.breaking = self.observer.publisher(String, "test/break", qos.stream(10))

    def start_senders(self) -> None:
        for name in self._names:
            if name not in self._senders:
                topics = " ".join(f"{word}/heartbeat" for word in name.split())
                self._senders[name] = self.start("heartbeat_sender", {"topics": topics})

    def lose(self, name: str, number: int) -> int:
        """Send a signal to a sender, which does not count as running any more; its time."""
        sent_ns = time.monotonic_ns()
        self._senders.pop(name).send(number)
        return sent_ns

    def light(self) -> None:
        """Switch on, from any state of the node and of the senders."""
        self.start_senders()

        def lit() -> bool:
            state = self.observer.lifecycle_state("laser")
            if state in WAYS_TO_ACTIVE:
                # A guard that is about to end may still hold the generator.
                self.observer.change_state("laser", WAYS_TO_ACTIVE[state])
            if state != "active":
                return False
            answers = self.arm(), self.enable()
            print("light:", *(answer.message for answer in answers))
            return all(answer.success for answer in answers)

        wait_until(lit, "light", poll_s=0.2)
        self.wait_for_state(LaserState.OUTPUT_ON)
        time.sleep(0.3)
        assert self.awg.lit()

    def check_off(self, cause: str, since_ns: int) -> None:
        took_s = self.awg.off_after_s(since_ns)
        print(f"{cause}: off after {took_s * 1e3:.1f} ms")
        assert 0.0 < took_s < OFF_LIMIT_S


@contextlib.contextmanager
def running(
    folder: Path, senders: tuple[str, ...] = (" ".join(SENDERS),), **parameters: Any
) -> Iterator[Bench]:
    with contextlib.ExitStack() as held:
        yield Bench(held, folder, senders, **parameters)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with running(tmp_path_factory.mktemp("laser"), SENDERS) as made:
        yield made


@pytest.fixture
def lit(shared: Bench) -> Bench:
    """A bench whose laser is on, for tests that its node survives."""
    shared.light()
    return shared


@pytest.fixture
def doomed(tmp_path: Path) -> Iterator[Bench]:
    """A bench whose laser is on, for tests that its node does not survive."""
    with running(tmp_path) as made:
        made.light()
        yield made


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_laser_node_gets_a_signal(doomed: Bench, number: int) -> None:
    sent_ns = time.monotonic_ns()
    doomed.node.send(number)
    doomed.check_off(signal.Signals(number).name, sent_ns)
    assert doomed.node.wait() == (-number if number == signal.SIGKILL else 0)
    assert doomed.awg.outputs() == ["OFF", "ON", "OFF"]
    assert "Traceback" not in doomed.node.output


@pytest.mark.parametrize("way", ["exception", "abort", "segfault"])
def test_laser_node_breaks_by_itself(doomed: Bench, way: str) -> None:
    sent_ns = time.monotonic_ns()
    doomed.breaking.publish(String(data=way))
    doomed.check_off(way, sent_ns)
    assert doomed.node.wait() != 0


def test_laser_node_is_stopped(lit: Bench) -> None:
    sent_ns = time.monotonic_ns()
    lit.node.send(signal.SIGSTOP)
    lit.check_off("SIGSTOP", sent_ns)
    lit.node.send(signal.SIGCONT)
    lit.wait_for_state(LaserState.OUTPUT_OFF)
    assert "not armed" in lit.enable().message


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGUSR1])
@pytest.mark.parametrize("name", SENDERS)
def test_sender_of_a_heartbeat_fails(lit: Bench, name: str, number: int) -> None:
    """Killed, stopped, or reporting that it stopped."""
    sent_ns = lit.lose(name, number)
    lit.check_off(f"{name} {signal.Signals(number).name}", sent_ns)
    lit.wait_for_reason(f"{name}/heartbeat")
    assert lit.states[-1].output == LaserState.OUTPUT_OFF
    assert lit.arm().success
    assert name in lit.enable().message
    assert not lit.awg.lit()


def test_guard_dies(lit: Bench) -> None:
    guard = _child(lit.node.pid, "eschorty_ros.hardware.laser_guard.guard")
    sent_ns = time.monotonic_ns()
    os.kill(guard, signal.SIGKILL)
    lit.check_off("guard SIGKILL", sent_ns)
    lit.observer.wait_for_state("laser", "unconfigured")
    lit.light()


def test_interlock(lit: Bench) -> None:
    sent_ns = time.monotonic_ns()
    lit.interlock.publish(Bool(data=True))
    lit.check_off("interlock", sent_ns)
    assert "interlock open" in lit.arm().message
    assert not lit.enable().success
    lit.interlock.publish(Bool(data=False))
    lit.wait_for_state(LaserState.OUTPUT_OFF)
    lit.light()


@pytest.mark.fault("USB unplugged")
def test_unplug_of_the_generator(lit: Bench) -> None:
    """driver: alarm, retries for 30 s, off on replug; user reads: laser state unknown"""
    lit.awg.do("gone")
    wait_until(lambda: lit.states[-1].output == LaserState.OUTPUT_UNKNOWN, "unknown")
    assert lit.awg.lit()

    def alarm() -> bool:
        status = [s for a in lit.diagnostics for s in a.status if s.name.endswith("laser")][-1:]
        return any(s.level == DiagnosticStatus.ERROR and "unknown" in s.message for s in status)

    wait_until(alarm, "the alarm in /diagnostics")
    lit.observer.wait_for_state("laser", "unconfigured")
    plugged_ns = time.monotonic_ns()
    lit.awg.do("back")
    print(f"off {lit.awg.off_after_s(plugged_ns):.2f} s after it was plugged in")
    lit.light()


@pytest.mark.fault("setting clamped or ignored")
def test_panel_touched_while_lit(lit: Bench) -> None:
    """driver: reads back five times a second, switches off; user reads: what differs"""
    lit.awg.do("touch BASE:FREQuency 90")
    wait_until(lambda: not lit.awg.lit(), "the output off")
    lit.wait_for_reason("90")
    # Before the next light.
    lit.observer.wait_for_state("laser", "unconfigured")


@pytest.mark.fault("generator rebooted")
def test_generator_restarted(lit: Bench) -> None:
    """driver: off, refuses light until configured; user reads: output reads back OFF"""
    lit.awg.do("reboot")
    assert not lit.awg.lit()
    wait_until(lambda: lit.states[-1].requested == LaserState.OUTPUT_OFF, "the request gone")
    assert "reads back OFF" in lit.states[-1].reason
    lit.arm()
    assert "configure it again" in lit.enable().message
    assert lit.observer.set_parameter("laser", "frequency", 80.0)[0]
    lit.light()


def test_required_interlock_is_open_unless_it_is_reported_closed(tmp_path: Path) -> None:
    with running(tmp_path, interlock_required=True, interlock_timeout=5.0) as bench:
        bench.observer.wait_for_state("laser", "active")
        wait_until(lambda: bench.states and bench.states[-1].interlock_open, "the interlock open")
        assert "interlock open" in bench.arm().message
        closing = bench.observer.node.create_timer(
            0.2, lambda: bench.interlock.publish(Bool(data=False))
        )
        wait_until(lambda: not bench.states[-1].interlock_open, "the interlock closed")
        bench.light()
        bench.observer.node.destroy_timer(closing)
        bench.wait_for_reason("interlock open")
        assert bench.states[-1].output == LaserState.OUTPUT_OFF


def _child(pid: int, module: str) -> int:
    """Return the process started by any thread of ``pid`` that runs ``module``."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        # A thread or a child may end meanwhile.
        with contextlib.suppress(OSError):
            for number in (task / "children").read_text().split():
                if module in Path(f"/proc/{number}/cmdline").read_text():
                    return int(number)
    raise AssertionError(f"no process of {module}")
