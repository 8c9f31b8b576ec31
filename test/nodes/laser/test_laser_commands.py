"""The laser node's services while one of them is in progress."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from delayed_laser import DelayedLaser
from diagnostic_msgs.msg import DiagnosticArray
from eschorty_ros.msg import LaserState
from ros_process import Observer, nodes_here, wait_until
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger
from waiting import DEADLINE_S

from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT
from eschorty_ros.control.laser_supervisor import LaserSupervisor
from eschorty_ros.nodes.laser.node import THREADS, LaserNode
from eschorty_ros.nodes.ros import drivers, qos


@pytest.fixture
def laser(monkeypatch: pytest.MonkeyPatch, observer: Observer) -> Iterator[DelayedLaser]:
    made = DelayedLaser()
    monkeypatch.setattr(drivers, "make", lambda *_: made)
    # One heartbeat and one arming must last, whatever delays this process.
    given = {"watch": "none", "heartbeat_timeout": 60.0, "arm_timeout": 3600.0}
    with nodes_here(observer.domain, THREADS) as start:
        start(LaserNode, **given)
        observer.wait_for_state("laser", "active")
        yield made
        made.go.set()


def test_disabling_does_not_wait_for_enabling(observer: Observer, laser: DelayedLaser) -> None:
    heartbeat = observer.publisher(Header, CLIENT_HEARTBEAT, qos.heartbeat())
    wait_until(heartbeat.get_subscription_count, "the heartbeat's subscriber")
    heartbeat.publish(Header())
    wait_until(lambda: observer.call(Trigger, "laser/arm").success, "arming")
    laser.delayed = "enable"
    with ThreadPoolExecutor() as pool:
        pool.submit(observer.call, SetBool, "laser/enable", SetBool.Request(data=True))
        assert laser.reached.wait(DEADLINE_S)
        pool.submit(observer.call, SetBool, "laser/enable", SetBool.Request(data=False))
        assert laser.disabled.wait(0.5 * DEADLINE_S), "disabling waits"
        laser.go.set()
    assert laser.enablings == 0


def test_commands_that_wait_leave_a_thread_for_disabling(
    observer: Observer, laser: DelayedLaser
) -> None:
    laser.delayed = "arm"
    with ThreadPoolExecutor() as pool:
        waiting = [pool.submit(observer.call, Trigger, "laser/arm") for _ in range(THREADS)]
        wait_until(lambda: any(answer.done() for answer in waiting), "a refusal")
        pool.submit(observer.call, SetBool, "laser/enable", SetBool.Request(data=False))
        assert laser.disabled.wait(0.5 * DEADLINE_S), "disabling waits"
        laser.go.set()
        refusals = [answer.result().message for answer in waiting if not answer.result().success]
    assert any("commands are under way" in refusal for refusal in refusals)


@pytest.mark.usefixtures("laser")
def test_arming_that_crosses_a_deactivation_is_refused(
    observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = LaserSupervisor.arm

    def arm_once_deactivated(supervisor: LaserSupervisor, *ticket: int) -> None:
        assert observer.change_state("laser", "deactivate")
        arm(supervisor, *ticket)

    monkeypatch.setattr(LaserSupervisor, "arm", arm_once_deactivated)
    answer = observer.call(Trigger, "laser/arm")
    assert (answer.success, answer.message) == (False, "laser refused: not active")


def test_interlock_that_is_reported_open_repeatedly_switches_off_once(
    observer: Observer, laser: DelayedLaser
) -> None:
    states = observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
    before = laser.offs
    interlock = observer.publisher(Bool, "laser/interlock", qos.stream(10))
    for _ in range(5):
        interlock.publish(Bool(data=True))
    wait_until(lambda: states and states[-1].interlock_open, "the open interlock")
    assert laser.offs == before + 1


@pytest.mark.usefixtures("laser")
def test_refusals_of_one_cause_are_logged_once_and_counted(
    observer: Observer, capfd: pytest.CaptureFixture[str]
) -> None:
    reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())

    def enable() -> str:
        return str(observer.call(SetBool, "laser/enable", SetBool.Request(data=True)).message)

    reasons = [enable() for _ in range(4)]
    observer.call(Trigger, "laser/arm")
    reasons.append(enable())
    assert len(set(reasons)) == 2
    assert "not armed" in reasons[0]
    log = capfd.readouterr().err
    assert [log.count(reason) for reason in sorted(set(reasons))] == [1, 1]
    wait_until(lambda: values(reports).get("refused") == "5", "the count in the diagnostics")


def values(reports: list[DiagnosticArray]) -> dict[str, str]:
    return {pair.key: pair.value for report in reports for pair in report.status[0].values}
