"""Whatever breaks, the generator's own log says that the light went off within 250 ms.

The laser node runs with its real driver and guard on an emulated generator in a process of its
own; scanner, camera and stage are stand-ins that only beat.
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

from awg_process import AwgProcess
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from eschorty_ros.msg import LaserState
from ros_process import NodeProcess, Observer, stamped_after, wait_until
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain

OFF_LIMIT_S = 0.25
TEST_FOLDER = str(Path(__file__).parents[2] / "support")
BEATING = ("laser", "camera", "stage")
WAYS_TO_ACTIVE = {"unconfigured": "configure", "inactive": "activate"}
# Whatever goes wrong here has to be noticed at once, without any of them; and none of them may
# end the light when a loaded machine lets the stand-ins wait.
TIMEOUTS = {f"{name}_timeout": 60.0 for name in ("heartbeat", "camera", "stage")}


class Bench:
    """Generator, laser node and whoever has to be alive, each a process that ``held`` ends."""

    def __init__(
        self,
        held: contextlib.ExitStack,
        folder: Path,
        stand_ins: tuple[str, ...],
        **parameters: Any,
    ) -> None:
        self._stand_ins = stand_ins
        self._held = held
        self.awg = held.enter_context(AwgProcess(folder))
        self.observer = held.enter_context(Observer(free_domain(), "safety_observer"))
        self.node = self._process(
            "breakable_laser",
            {"driver": "awg", "backend": self.awg.backend, **TIMEOUTS, **parameters},
        )
        self.beating: dict[str, NodeProcess] = {}
        self.revive()
        self.states = self.observer.collect(
            LaserState, "laser/state", qos.latched(qos.STATE_HISTORY)
        )
        self.diagnostics = self.observer.collect(DiagnosticArray, "/diagnostics", qos.stream(100))
        self.breaking = self.observer.publisher(String, "test/break", qos.stream(10))
        self.interlock = self.observer.publisher(Bool, "laser/interlock", qos.stream(10))

    def _process(self, module: str, parameters: dict[str, Any]) -> NodeProcess:
        process = self._held.enter_context(
            NodeProcess(module, parameters, domain=self.observer.domain)
        )
        self._held.callback(lambda: print(f"--- {process.module}\n{process.output}"))
        return process

    def revive(self) -> None:
        """Start the stand-ins that do not run."""
        for name in self._stand_ins:
            if name not in self.beating:
                topics = " ".join(f"{word}/heartbeat" for word in name.split())
                self.beating[name] = self._process("heartbeat_sender", {"topics": topics})

    def lose(self, name: str, number: int = signal.SIGKILL) -> int:
        """Send a stand-in a deadly signal; the time of it."""
        process = self.beating.pop(name)
        sent_ns = time.monotonic_ns()
        process.send(number)
        return sent_ns

    def arm(self) -> Any:
        return self.observer.call(Trigger, "laser/arm")

    def enable(self, on: bool = True) -> Any:
        return self.observer.call(SetBool, "laser/enable", SetBool.Request(data=on))

    def light(self) -> None:
        """Switch on, with everybody there, from whatever state the node is in; told on return."""
        self.revive()

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
        self.wait_for_told(LaserState.OUTPUT_ON)
        time.sleep(0.3)
        assert self.awg.lit()

    def wait_for_told(self, output: int) -> None:
        """Wait until a state from after now says that this is asked for, and so; interlock closed.

        What was told last may be about the light before.
        """
        now_ns = time.time_ns()

        def told() -> bool:
            newest = self.states[-1:]
            return stamped_after(newest, now_ns) and (
                newest[0].requested == newest[0].output == output and not newest[0].interlock_open
            )

        wait_until(told, f"output {output} in laser/state")

    def dark_after(self, cause: str, since_ns: int) -> None:
        took_s = self.awg.off_after_s(since_ns)
        print(f"{cause}: dark after {took_s * 1e3:.1f} ms")
        assert 0.0 < took_s < OFF_LIMIT_S


@pytest.fixture(scope="module", autouse=True)
def importable() -> Iterator[None]:
    """The processes import modules of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{TEST_FOLDER}:{os.environ.get('PYTHONPATH', '')}")
        yield


@contextlib.contextmanager
def running(
    folder: Path, stand_ins: tuple[str, ...] = (" ".join(BEATING),), **parameters: Any
) -> Iterator[Bench]:
    with contextlib.ExitStack() as held:
        yield Bench(held, folder, stand_ins, **parameters)


@pytest.fixture(scope="module")
def shared(importable: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with running(tmp_path_factory.mktemp("laser"), BEATING) as made:
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


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_laser_node_gets_a_signal(doomed: Bench, number: int) -> None:
    sent_ns = time.monotonic_ns()
    doomed.node.send(number)
    doomed.dark_after(signal.Signals(number).name, sent_ns)
    assert doomed.node.wait() == (-number if number == signal.SIGKILL else 0)


@pytest.mark.parametrize("way", ["exception", "abort", "segfault"])
def test_laser_node_breaks_by_itself(doomed: Bench, way: str) -> None:
    sent_ns = time.monotonic_ns()
    doomed.breaking.publish(String(data=way))
    doomed.dark_after(way, sent_ns)
    assert doomed.node.wait() != 0


def test_laser_node_is_stopped(lit: Bench) -> None:
    sent_ns = time.monotonic_ns()
    lit.node.send(signal.SIGSTOP)
    lit.dark_after("SIGSTOP", sent_ns)
    lit.node.send(signal.SIGCONT)
    lit.wait_for_told(LaserState.OUTPUT_OFF)
    assert "not armed" in lit.enable().message


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGUSR1])
@pytest.mark.parametrize("name", BEATING)
def test_whoever_light_depends_on_dies(lit: Bench, name: str, number: int) -> None:
    """Killed, stopped, or well no longer and saying so."""
    sent_ns = lit.lose(name, number)
    lit.dark_after(f"{name} {signal.Signals(number).name}", sent_ns)
    wait_until(lambda: f"{name}/heartbeat" in lit.states[-1].reason, "the reason")
    assert lit.states[-1].output == LaserState.OUTPUT_OFF
    assert lit.arm().success
    assert name in lit.enable().message
    assert not lit.awg.lit()


def test_guard_dies(lit: Bench) -> None:
    guard = _child(lit.node.pid, "eschorty_ros.hardware.laser_guard.guard")
    sent_ns = time.monotonic_ns()
    os.kill(guard, signal.SIGKILL)
    lit.dark_after("guard SIGKILL", sent_ns)
    lit.observer.wait_for_state("laser", "unconfigured")
    lit.light()


def test_interlock(lit: Bench) -> None:
    sent_ns = time.monotonic_ns()
    lit.interlock.publish(Bool(data=True))
    lit.dark_after("interlock", sent_ns)
    assert "interlock open" in lit.arm().message
    lit.interlock.publish(Bool(data=False))
    lit.wait_for_told(LaserState.OUTPUT_OFF)
    lit.light()


@pytest.mark.fault("USB unplugged")
def test_unplug_of_the_generator(lit: Bench) -> None:
    """driver: alarm, tries again for 30 s, off on replug; user reads: laser state unknown"""
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
    took_s = lit.awg.off_after_s(plugged_ns)
    print(f"dark {took_s:.2f} s after it was plugged in")
    lit.light()


@pytest.mark.fault("setting clamped or ignored")
def test_panel_touched_while_lit(lit: Bench) -> None:
    """driver: reads back five times a second, switches off; user reads: what differs"""
    lit.awg.do("touch BASE:FREQuency 90")
    wait_until(lambda: not lit.awg.lit(), "dark")
    wait_until(lambda: "90" in lit.states[-1].reason, "the reason in laser/state")
    # The fault that it ends with, lest it meets the next light.
    lit.observer.wait_for_state("laser", "unconfigured")


@pytest.mark.fault("generator rebooted")
def test_generator_restarted(lit: Bench) -> None:
    """driver: dark, refuses light until configured; user reads: output reads back OFF"""
    lit.awg.do("reboot")
    assert not lit.awg.lit()
    wait_until(lambda: lit.states[-1].requested == LaserState.OUTPUT_OFF, "no longer asked for")
    assert "reads back OFF" in lit.states[-1].reason
    lit.arm()
    assert "configure it again" in lit.enable().message
    assert lit.observer.set_parameter("laser", "frequency", 80.0)[0]
    lit.light()


def test_interlock_that_is_required_is_open_unless_it_says_closed(tmp_path: Path) -> None:
    with running(tmp_path, interlock_required=True, interlock_timeout=10.0) as bench:
        bench.observer.wait_for_state("laser", "active")
        wait_until(lambda: bench.states and bench.states[-1].interlock_open, "the interlock open")
        assert "interlock open" in bench.arm().message
        closing = bench.observer.node.create_timer(
            0.2, lambda: bench.interlock.publish(Bool(data=False))
        )
        wait_until(lambda: not bench.states[-1].interlock_open, "the interlock closed")
        bench.light()
        # Nobody says closed any more.
        bench.observer.node.destroy_timer(closing)
        wait_until(lambda: bench.states[-1].output == LaserState.OUTPUT_OFF, "the laser off")
        assert "interlock open" in bench.states[-1].reason


def _child(pid: int, module: str) -> int:
    """Process started by any thread of ``pid`` that runs ``module``."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        # A thread or a child may end meanwhile.
        with contextlib.suppress(OSError):
            for number in (task / "children").read_text().split():
                if module in Path(f"/proc/{number}/cmdline").read_text():
                    return int(number)
    raise AssertionError(f"no process of {module}")
