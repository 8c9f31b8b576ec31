"""The laser node as a process: the emulated generator's own log shows when it was on."""

import contextlib
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from eschorty_ros.msg import LaserState
from laser_bench import OFF_LIMIT_S, LaserBench
from output_log import read_output_log
from ros_process import NodeProcess, ros_minus_steady_ns, stamped_after, wait_until
from std_msgs.msg import Header

from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain

MODULE = "eschorty_ros.nodes.laser.node"
MAX_ON_S = 5.0
STALE_S = 2.0
PARAMETERS = {
    "arm_timeout": 60.0,
    "heartbeat_timeout": STALE_S,
    "max_on_time": MAX_ON_S,
    "watch": "none",
}


class Bench(LaserBench):
    """A laser node with a heartbeat that can be switched."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, **parameters: Any) -> None:
        super().__init__(stack, folder, **{**PARAMETERS, **parameters})
        observer, self.alive = self.observer, False
        self._heartbeat = observer.publisher(Header, CLIENT_HEARTBEAT, qos.stream(10))
        timer = observer.node.create_timer(0.03, self._send)
        stack.callback(observer.node.destroy_timer, timer)
        observer.wait_for_state("laser", "active")
        wait_until(self._heartbeat.get_subscription_count, "the heartbeat's subscriber")
        wait_until(lambda: self.states, "a laser state")

    def _send(self) -> None:
        if self.alive:
            self._heartbeat.publish(Header())

    def switched_ns(self) -> list[int]:
        """Times at which the last light began and ended, CLOCK_MONOTONIC."""
        return [t_ns for t_ns, _ in read_output_log(self.awg.log)[-2:]]

    def switch_on(self) -> None:
        """Heartbeat, arm, enable, in the order in which a client does it."""
        self.alive = True
        before = len(self.awg.outputs())

        def lit() -> bool:
            assert self.arm().success
            answer = self.enable()
            # The first heartbeat may still be on its way.
            assert answer.success or CLIENT_HEARTBEAT in answer.message, answer.message
            return bool(answer.success)

        wait_until(lit, "light")
        assert "ON" in self.awg.outputs()[before:]

    def wait_until_off(self) -> None:
        wait_until(lambda: not self.awg.lit(), "the laser off in the log")


@contextlib.contextmanager
def running(folder: Path, **parameters: Any) -> Iterator[Bench]:
    with contextlib.ExitStack() as stack:
        yield Bench(stack, folder, **parameters)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with running(tmp_path_factory.mktemp("laser")) as bench:
        yield bench


@pytest.fixture
def bench(shared: Bench) -> Iterator[Bench]:
    yield shared
    shared.alive = False
    shared.contact.close()
    shared.enable(False)
    if shared.observer.lifecycle_state("laser") == "inactive":
        assert shared.observer.change_state("laser", "activate")
    assert shared.awg.outputs()[-1] == "OFF"


def test_laser_is_off_at_start(bench: Bench) -> None:
    assert bench.awg.outputs() == ["OFF"]
    assert bench.states[-1].output == LaserState.OUTPUT_OFF


def test_state_of_a_laser_that_is_seldom_read_back_still_comes(tmp_path: Path) -> None:
    with running(tmp_path, readback_rate=0.1) as bench:
        before = len(bench.states)
        wait_until(lambda: len(bench.states) >= before + 3, "states without a change")


def test_enable_is_refused_with_the_reason(bench: Bench) -> None:
    assert "not armed" in bench.enable().message
    bench.arm()
    # Until the heartbeats of the test before are stale.
    time.sleep(1.2 * STALE_S)
    refused = bench.enable()
    assert not refused.success
    assert "heartbeat" in refused.message
    assert "ON" not in bench.awg.outputs()


def test_arming_expires(tmp_path: Path) -> None:
    with running(tmp_path, arm_timeout=0.1) as bench:
        assert bench.arm().success
        time.sleep(0.2)
        assert "arming expired" in bench.enable().message
        assert "ON" not in bench.awg.outputs()


@pytest.mark.parametrize(
    ("peers", "allowed"), [("scanner observer", True), ("scanner, /other/observer", False)]
)
def test_only_heartbeats_of_allowed_peers_count(tmp_path: Path, peers: str, allowed: bool) -> None:
    with running(tmp_path, allowed_peers=peers) as bench:
        if allowed:
            bench.switch_on()
            return
        bench.alive = True
        ignored = "laser/heartbeat of /eschorty/observer ignored: not in allowed_peers"
        wait_until(lambda: ignored in bench.node.output, "the refusal in the log")
        assert bench.arm().success
        assert "no laser/heartbeat" in bench.enable().message


def test_lost_heartbeat_switches_off(bench: Bench) -> None:
    bench.switch_on()
    bench.alive = False
    bench.wait_until_off()
    bench.wait_for_reason("heartbeat")


def test_light_ends_after_the_longest_time_on(tmp_path: Path) -> None:
    # No heartbeat that a loaded machine delays may end the light before.
    with running(tmp_path, heartbeat_timeout=60.0) as bench:
        bench.switch_on()
        bench.wait_until_off()
        on_ns, off_ns = bench.switched_ns()
        # Counted from the request, which the generator takes some time to fulfil.
        assert (off_ns - on_ns) * 1e-9 < MAX_ON_S + OFF_LIMIT_S
        bench.wait_for_reason("max_on_time")


def test_deactivate_switches_off_and_refuses(bench: Bench) -> None:
    bench.switch_on()
    assert bench.observer.change_state("laser", "deactivate")
    assert bench.awg.outputs()[-1] == "OFF"
    assert "inactive" in bench.arm().message
    assert not bench.enable().success
    assert bench.awg.outputs()[-1] == "OFF"


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


def test_state_reports_every_switch_with_its_time(bench: Bench) -> None:
    bench.switch_on()
    assert bench.enable(False).success
    now_ns = time.time_ns()
    wait_until(lambda: stamped_after(bench.states, now_ns), "a new laser/state")
    assert bench.states[-1].output == LaserState.OUTPUT_OFF
    to_ros_ns = ros_minus_steady_ns()
    switched_ns = [t_ns + to_ros_ns for t_ns in bench.switched_ns()]
    since_ns = sorted({s.output_since.sec * 10**9 + s.output_since.nanosec for s in bench.states})
    # Each is reported once it is read back.
    for switch_ns, reported_ns in zip(switched_ns, since_ns[-2:], strict=True):
        assert reported_ns > switch_ns - 1_000_000
    assert since_ns[-2] < switched_ns[1]


@pytest.mark.parametrize("pause_s", [0.003, 0.02], ids=["rapidly", "again"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_repeated_signal_switches_off_and_exits_clean(
    number: int, pause_s: float, tmp_path: Path
) -> None:
    with running(tmp_path) as bench:
        bench.switch_on()
        bench.node.send(number)
        while bench.node.running():
            time.sleep(pause_s)
            bench.node.send(number)
        assert bench.node.wait() == 0
        assert bench.awg.outputs() == ["OFF", "ON", "OFF"]
        assert "Traceback" not in bench.node.output
        reason = "its node was ended"
        wait_until(lambda: bench.states[-1].reason == reason, "the reason")


@pytest.mark.parametrize(("name", "value"), [("driver", "quantum"), ("frequency", 5.0)])
def test_a_value_out_of_range_at_start_ends_with_one_line(name: str, value: object) -> None:
    with NodeProcess(MODULE, {name: value}, domain=free_domain()) as process:
        assert process.wait() == 1
        assert process.output.startswith(f"error: parameter {name}")
        assert len(process.output.strip().splitlines()) == 1
