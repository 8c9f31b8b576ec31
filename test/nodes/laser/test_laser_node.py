"""The laser node as a process: the emulated generator's own log says when there was light."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from awg_process import AwgProcess
from eschorty_ros.msg import LaserState
from ros_process import NodeProcess, Observer, ros_minus_steady_ns, stamped_after, wait_until
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT
from eschorty_ros.emulation.awg.model import truth
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain

MODULE = "eschorty_ros.nodes.laser.node"
OFF_LIMIT_S = 0.25
MAX_ON_S = 5.0
STALE_S = 2.0
PARAMETERS = {
    "arm_timeout": 60.0,
    "heartbeat_timeout": STALE_S,
    "max_on_time": MAX_ON_S,
    "watch": "none",
}


class Bench:
    """A laser node with its log, its state and a heartbeat that can be switched.

    ``held`` ends the processes.
    """

    def __init__(
        self, held: contextlib.ExitStack, folder: Path, observer: Observer, **parameters: Any
    ) -> None:
        self.awg = held.enter_context(AwgProcess(folder))
        self.observer = observer
        self.beating = False
        self.process = held.enter_context(
            NodeProcess(
                MODULE,
                {**PARAMETERS, "driver": "awg", "backend": self.awg.backend, **parameters},
                domain=observer.domain,
            )
        )
        self.states = observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
        self._heart = observer.node.create_publisher(Header, "laser/heartbeat", qos.stream(10))
        timer = observer.node.create_timer(0.03, self._beat)
        held.callback(observer.node.destroy_timer, timer)
        self.interlock = observer.node.create_publisher(Bool, "laser/interlock", qos.stream(10))
        observer.wait_for_state("laser", "active")
        wait_until(self._heart.get_subscription_count, "the heartbeat's subscriber")
        wait_until(self.interlock.get_subscription_count, "the interlock's subscriber")
        wait_until(lambda: self.states, "a laser state")

    def _beat(self) -> None:
        if self.beating:
            self._heart.publish(Header())

    def light(self) -> list[str]:
        """ON and OFF as the generator logged them."""
        return self.awg.outputs()

    def switched_ns(self) -> list[int]:
        """Times of the last light's begin and end, CLOCK_MONOTONIC."""
        return [t_ns for t_ns, _ in truth(self.awg.log)[-2:]]

    def arm(self) -> Any:
        return self.observer.call(Trigger, "laser/arm")

    def enable(self, on: bool = True) -> Any:
        return self.observer.call(SetBool, "laser/enable", SetBool.Request(data=on))

    def switch_on(self) -> None:
        """Heartbeat, arm, enable, in the order a client does it."""
        self.beating = True
        before = len(self.light())

        def lit() -> bool:
            assert self.arm().success
            answer = self.enable()
            # The first beat may still be on its way.
            assert answer.success or CLIENT_HEARTBEAT in answer.message, answer.message
            return bool(answer.success)

        wait_until(lit, "light")
        assert "ON" in self.light()[before:]

    def wait_dark(self) -> None:
        wait_until(lambda: self.light()[-1] == "OFF", "the laser off in the log")

    def close_interlock(self) -> None:
        """Say that the interlock is closed; told on return."""
        self.interlock.publish(Bool(data=False))
        said_ns = time.time_ns()
        wait_until(
            lambda: stamped_after(self.states, said_ns) and not self.states[-1].interlock_open,
            "the interlock closed",
        )


@contextlib.contextmanager
def running(folder: Path, observer: Observer, **parameters: Any) -> Iterator[Bench]:
    with contextlib.ExitStack() as held:
        yield Bench(held, folder, observer, **parameters)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with (
        Observer(free_domain(), "laser_observer") as observer,
        running(tmp_path_factory.mktemp("laser"), observer) as bench,
    ):
        yield bench


@pytest.fixture
def bench(shared: Bench) -> Iterator[Bench]:
    yield shared
    shared.beating = False
    shared.close_interlock()
    shared.enable(False)
    if shared.observer.lifecycle_state("laser") == "inactive":
        assert shared.observer.change_state("laser", "activate")
    assert shared.light()[-1] == "OFF"


def test_laser_is_off_at_start(bench: Bench) -> None:
    assert bench.light() == ["OFF"]
    assert bench.states[-1].output == LaserState.OUTPUT_OFF


def test_enable_is_refused_with_the_reason(bench: Bench) -> None:
    assert "not armed" in bench.enable().message
    bench.arm()
    # Beats of the test before.
    time.sleep(1.2 * STALE_S)
    refused = bench.enable()
    assert not refused.success
    assert "heartbeat" in refused.message
    assert "ON" not in bench.light()


def test_arming_expires(tmp_path: Path) -> None:
    with (
        Observer(free_domain(), "arming_observer") as own,
        running(tmp_path, own, arm_timeout=0.1) as bench,
    ):
        assert bench.arm().success
        time.sleep(0.2)
        assert "arming expired" in bench.enable().message
        assert "ON" not in bench.light()


def test_open_interlock_refuses_and_switches_off(bench: Bench) -> None:
    bench.interlock.publish(Bool(data=True))
    wait_until(lambda: bench.states[-1].interlock_open, "the interlock open")
    assert "interlock open" in bench.arm().message
    bench.close_interlock()
    bench.switch_on()
    bench.interlock.publish(Bool(data=True))
    bench.wait_dark()
    assert not bench.enable().success


def test_lost_heartbeat_switches_off(bench: Bench) -> None:
    bench.switch_on()
    bench.beating = False
    bench.wait_dark()
    wait_until(lambda: "heartbeat" in bench.states[-1].reason, "the reason in laser/state")


def test_light_ends_after_the_longest_time_on(tmp_path: Path) -> None:
    # No beat that a loaded machine holds up may end the light before.
    with (
        Observer(free_domain(), "longest_observer") as own,
        running(tmp_path, own, heartbeat_timeout=60.0) as bench,
    ):
        bench.switch_on()
        bench.wait_dark()
        on_ns, off_ns = bench.switched_ns()
        # Counted from the request, which the generator takes some time to fulfil.
        assert (off_ns - on_ns) * 1e-9 < MAX_ON_S + OFF_LIMIT_S
        wait_until(lambda: "max_on_time" in bench.states[-1].reason, "the reason in laser/state")


def test_deactivate_switches_off_and_refuses(bench: Bench) -> None:
    bench.switch_on()
    assert bench.observer.change_state("laser", "deactivate")
    assert bench.light()[-1] == "OFF"
    assert "inactive" in bench.arm().message
    assert not bench.enable().success
    assert bench.light()[-1] == "OFF"


def test_bad_parameter_is_refused_and_changes_nothing(bench: Bench) -> None:
    for name, value in (("frequency", 5.0), ("duty", 1.5), ("waveform", "triangle")):
        accepted, reason = bench.observer.set_parameter("laser", name, value)
        assert not accepted
        assert name in reason
    assert not bench.observer.set_parameter("laser", "freqency", 70.0)[0]
    state = bench.states[-1]
    assert (state.frequency, state.duty, state.waveform) == (70.0, 0.5, "square")
    accepted, reason = bench.observer.set_parameter("laser", "frequency", 100)
    assert accepted, reason
    wait_until(lambda: bench.states[-1].frequency == 100.0, "the new frequency")


def test_state_tells_every_switch_with_its_time(bench: Bench) -> None:
    bench.switch_on()
    assert bench.enable(False).success
    now_ns = time.time_ns()
    wait_until(lambda: stamped_after(bench.states, now_ns), "a new laser/state")
    assert bench.states[-1].output == LaserState.OUTPUT_OFF
    to_ros_ns = ros_minus_steady_ns()
    switched_ns = [t_ns + to_ros_ns for t_ns in bench.switched_ns()]
    told_ns = sorted({s.output_since.sec * 10**9 + s.output_since.nanosec for s in bench.states})
    # Each was told, when it had been read back.
    for switch_ns, since_ns in zip(switched_ns, told_ns[-2:], strict=True):
        assert since_ns > switch_ns - 1_000_000
    assert told_ns[-2] < switched_ns[1]


@pytest.mark.parametrize("pause_s", [None, 0.003, 0.02], ids=["once", "rapidly", "again"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_switches_off_and_exits_clean(
    number: int, pause_s: float | None, tmp_path: Path
) -> None:
    with Observer(free_domain(), "signal_observer") as own, running(tmp_path, own) as bench:
        bench.switch_on()
        bench.process.send(number)
        while pause_s is not None and bench.process.running():
            time.sleep(pause_s)
            bench.process.send(number)
        assert bench.process.wait() == 0
        assert bench.light() == ["OFF", "ON", "OFF"]
        assert "Traceback" not in bench.process.output


def test_unknown_driver_is_one_clear_line() -> None:
    with (
        Observer(free_domain(), "driver_observer") as own,
        NodeProcess(MODULE, {"driver": "quantum"}, domain=own.domain) as process,
    ):
        wait_until(lambda: "choose one of" in process.output, "the refusal")
        assert "quantum" in process.output
        assert "Traceback" not in process.output
        assert own.lifecycle_state("laser") == "unconfigured"
        assert process.interrupt() == 0


def test_frequency_out_of_range_at_start_ends_with_one_line() -> None:
    with NodeProcess(MODULE, {"frequency": 5.0}, domain=free_domain()) as process:
        assert process.wait() == 1
        assert process.output.startswith("error: parameter frequency")
        assert len(process.output.strip().splitlines()) == 1
