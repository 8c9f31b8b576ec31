"""Whatever fails, the generator's own log shows the output off within 250 ms.

Scanner, camera and stage are processes that only send heartbeats.
"""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from eschorty_ros.msg import LaserState
from rclpy.node import Node
from ros_process import NAMESPACE, wait_until
from safety_bench import SENDERS, SafetyBench, guard_of, running
from std_msgs.msg import Bool, Header, String

from eschorty_ros.control.heartbeat import place
from eschorty_ros.nodes.ros import qos


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SafetyBench]:
    with running(tmp_path_factory.mktemp("laser"), SENDERS) as made:
        yield made


@pytest.fixture
def lit(shared: SafetyBench) -> SafetyBench:
    """A bench whose laser is on, for tests that its node survives."""
    shared.light()
    return shared


@pytest.fixture
def doomed(lit: SafetyBench) -> Iterator[SafetyBench]:
    """A bench whose laser is on, for tests that its node does not survive."""
    yield lit
    lit.restart()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_laser_node_gets_a_signal(doomed: SafetyBench, number: int) -> None:
    before = len(doomed.awg.outputs())
    sent_ns = time.monotonic_ns()
    doomed.node.send(number)
    doomed.check_off(signal.Signals(number).name, sent_ns)
    assert doomed.node.wait() == (-number if number == signal.SIGKILL else 0)
    assert doomed.awg.outputs()[before:] == ["OFF"]
    assert "Traceback" not in doomed.node.output


@pytest.mark.parametrize("way", ["exception", "abort", "segfault"])
def test_laser_node_breaks_by_itself(doomed: SafetyBench, way: str) -> None:
    sent_ns = time.monotonic_ns()
    doomed.breaking.publish(String(data=way))
    doomed.check_off(way, sent_ns)
    assert doomed.node.wait() != 0


def test_laser_node_is_stopped(lit: SafetyBench) -> None:
    sent_ns = time.monotonic_ns()
    lit.node.send(signal.SIGSTOP)
    lit.check_off("SIGSTOP", sent_ns)
    lit.node.send(signal.SIGCONT)
    lit.wait_for_state(LaserState.OUTPUT_OFF)
    assert "not armed" in lit.enable().message


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGUSR1])
@pytest.mark.parametrize("name", SENDERS)
def test_sender_of_a_heartbeat_fails(lit: SafetyBench, name: str, number: int) -> None:
    """Killed, stopped, or reporting that it stopped."""
    sent_ns = lit.lose(name, number)
    lit.check_off(f"{name} {signal.Signals(number).name}", sent_ns)
    lit.wait_for_reason(f"{name}/heartbeat")
    assert lit.states[-1].output == LaserState.OUTPUT_OFF
    assert lit.arm().success
    assert name in lit.enable().message
    assert not lit.awg.lit()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_guard_dies(lit: SafetyBench, number: int) -> None:
    guard = guard_of(lit.node.pid)
    sent_ns = time.monotonic_ns()
    os.kill(guard, number)
    lit.check_off(f"guard {signal.Signals(number).name}", sent_ns)
    lit.observer.wait_for_state("laser", "unconfigured")


def test_deactivating_switches_off_first(lit: SafetyBench) -> None:
    lit.check_off("deactivate", lit.change("deactivate"))
    lit.observer.wait_for_state("laser", "inactive")


def test_shutting_down_switches_off_first(doomed: SafetyBench) -> None:
    doomed.check_off("shutdown", doomed.change("shutdown"))


def test_interlock(lit: SafetyBench) -> None:
    sent_ns = time.monotonic_ns()
    lit.contact.open()
    lit.check_off("interlock", sent_ns)
    assert "interlock open" in lit.arm().message
    assert not lit.enable().success
    lit.contact.close()
    lit.light()


def test_an_interlock_that_one_source_opened_stays_open_until_it_is_reset(
    lit: SafetyBench,
) -> None:
    lit.contact.close()
    node = Node("door", namespace=NAMESPACE, context=lit.observer.node.context)
    door = node.create_publisher(Bool, "laser/interlock", qos.stream(10))
    wait_until(door.get_subscription_count, "the interlock's subscriber")
    sent_ns = time.monotonic_ns()
    door.publish(Bool(data=True))
    lit.check_off("interlock of another source", sent_ns)
    assert not lit.contact.reset()

    def named() -> bool:
        # The name of a new node may be discovered after its first message.
        door.publish(Bool(data=True))
        return "interlock open (/eschorty/door)" in lit.arm().message

    wait_until(named, "the source by its name")
    door.publish(Bool(data=False))
    latched = "was opened (/eschorty/door); call laser/reset_interlock"
    wait_until(lambda: latched in lit.arm().message, "the latch")
    assert lit.contact.reset()
    lit.light()
    node.destroy_node()


def test_foreign_heartbeats_keep_no_light(tmp_path: Path) -> None:
    """Nor does any text of them end the node."""
    texts = ("", f"{place()} {os.getpid()}", f"host {'9' * 5000}")
    with running(tmp_path) as bench:
        bench.light()
        observer = bench.observer
        for publisher in [
            observer.publisher(Header, f"{name}/heartbeat", qos.heartbeat()) for name in SENDERS
        ]:
            for text in texts:
                message = Header(frame_id=text)
                observer.node.create_timer(0.05, lambda p=publisher, m=message: p.publish(m))
        time.sleep(0.5)
        assert bench.awg.lit()
        bench.check_off("SIGKILL", bench.lose(" ".join(SENDERS), signal.SIGKILL))
        bench.wait_for_reason("/heartbeat: process")
        assert bench.node.running()


@pytest.mark.fault("USB unplugged")
def test_unplug_of_the_generator(lit: SafetyBench) -> None:
    """driver: alarm, retries for 30 s, off after light_grant; user reads: laser state unknown"""
    lit.awg.do("gone")
    wait_until(lambda: lit.states[-1].output == LaserState.OUTPUT_UNKNOWN, "unknown")
    # Without renewals.
    wait_until(lambda: not lit.awg.lit(), "dark")

    def alarm() -> bool:
        status = [s for a in lit.diagnostics for s in a.status if s.name.endswith("laser")][-1:]
        return any(s.level == DiagnosticStatus.ERROR and "unknown" in s.message for s in status)

    wait_until(alarm, "the alarm in /diagnostics")
    lit.observer.wait_for_state("laser", "unconfigured")
    lit.awg.do("back")
    lit.light()


@pytest.mark.fault("setting clamped or ignored")
def test_panel_touched_while_lit(lit: SafetyBench) -> None:
    """driver: reads back five times a second, switches off; user reads: what differs"""
    lit.awg.do("touch BASE:FREQuency 90")
    wait_until(lambda: not lit.awg.lit(), "the output off")
    lit.wait_for_reason("90")
    # Before the next light.
    lit.observer.wait_for_state("laser", "unconfigured")


@pytest.mark.fault("generator rebooted")
def test_generator_restarted(lit: SafetyBench) -> None:
    """driver: off, refuses light until configured; user reads: output reads back OFF"""
    lit.awg.do("reboot")
    assert not lit.awg.lit()
    wait_until(lambda: lit.states[-1].requested == LaserState.OUTPUT_OFF, "the request gone")
    # Whichever of output and settings is read first.
    reason = lit.states[-1].reason
    assert "reads back OFF" in reason or "not read back" in reason
    lit.arm()
    assert "configure it again" in lit.enable().message
    assert lit.observer.set_parameter("laser", "frequency", 80.0)[0]
    lit.light()


def test_required_interlock_is_open_unless_it_is_reported_closed(tmp_path: Path) -> None:
    with running(tmp_path, interlock_required=True, interlock_timeout=5.0) as bench:
        bench.observer.wait_for_state("laser", "active")
        wait_until(lambda: bench.states and bench.states[-1].interlock_open, "the interlock open")
        assert "interlock open" in bench.arm().message
        bench.contact.close()
        bench.light()
        bench.contact.end()
        bench.wait_for_reason("interlock open")
        assert bench.states[-1].output == LaserState.OUTPUT_OFF
