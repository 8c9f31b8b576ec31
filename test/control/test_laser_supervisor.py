"""Commands, disabling and the generator's answers that cross each other."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from delayed_laser import DelayedLaser
from stall_clock import StallClock
from waiting import DEADLINE_S, wait_until

from eschorty_ros.control import laser_supervisor
from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT, LaserInterlock
from eschorty_ros.control.laser_readback import LaserStatus
from eschorty_ros.control.laser_supervisor import LaserSupervisor
from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserOutput, LaserReadback
from eschorty_ros.hardware.laser.in_flight import VoidedError


@pytest.fixture
def laser() -> Iterator[DelayedLaser]:
    made = DelayedLaser()
    yield made
    made.go.set()


def opened(
    laser: DelayedLaser,
    interlock: LaserInterlock,
    publish: Callable[[LaserStatus], None] = lambda status: None,
    alarm: Callable[[str], None] = print,
) -> LaserSupervisor:
    made = LaserSupervisor(
        interlock, running=lambda: True, publish=publish, alarm=alarm, log=print,
        readback_period_s=0.02,
    )  # fmt: skip
    interlock.receive_heartbeat()
    made.open(laser, Modulation(70.0))
    return made


@pytest.fixture
def supervisor(laser: DelayedLaser) -> Iterator[LaserSupervisor]:
    made = opened(laser, LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0}))
    yield made
    laser.go.set()
    made.close()


def arm(supervisor: LaserSupervisor) -> None:
    supervisor.arm(supervisor.ticket())


def enable(supervisor: LaserSupervisor) -> None:
    supervisor.enable(supervisor.ticket())


class Turns:
    """A lock that counts who waits for it; reading back does not."""

    def __init__(self) -> None:
        self.asked = 0
        lock = threading.Lock()
        self.acquire, self.release = lock.acquire, lock.release

    def __enter__(self) -> None:
        self.asked += 1
        self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


def in_thread(step: Callable[[], None], failures: list[str]) -> threading.Thread:
    def attempt() -> None:
        try:
            step()
        except DeviceError as error:
            failures.append(str(error))

    thread = threading.Thread(target=attempt)
    thread.start()
    return thread


def test_enabled_twice_it_stays_on(supervisor, laser):
    arm(supervisor)
    enable(supervisor)
    enable(supervisor)
    assert laser.lit
    assert laser.enablings == 1


def test_light_that_ends_by_itself_is_reported_with_why_it_is_off(laser):
    seen: list[LaserStatus] = []
    interlock = LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0})
    supervisor = opened(laser, interlock, seen.append)
    arm(supervisor)
    enable(supervisor)
    laser.lit = False
    wait_until(lambda: seen[-1].requested is LaserOutput.OFF, "the request to be taken back")
    supervisor.close()
    lit = [status for status in seen if status.reason == "switched on by request"]
    assert lit
    assert all(status.readback.output is LaserOutput.ON for status in lit)
    assert "reads back OFF, requested ON" in seen[-1].reason


def test_a_trip_stays_the_reason_until_it_is_armed_again(laser):
    seen: list[LaserStatus] = []
    interlock = LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0})
    supervisor = opened(laser, interlock, seen.append)
    for request in (arm, enable):
        request(supervisor)
    supervisor.trip("interlock open (door); close it")
    # As the scanner does on its way out.
    supervisor.disable("switched off by request")
    assert seen[-1].reason == "interlock open (door); close it"
    arm(supervisor)
    supervisor.disable("switched off by request")
    assert seen[-1].reason == "switched off by request"
    supervisor.close()


class Lost(DelayedLaser):
    """Cannot be reached once it is ``gone``."""

    gone = False

    def disable(self) -> None:
        if self.gone:
            raise DeviceError("switch the generator off by hand")
        super().disable()

    def readback(self) -> LaserReadback:
        if self.gone:
            raise DeviceError("no answer")
        return super().readback()


def test_what_to_do_about_an_unknown_output_comes_before_what_tripped_it():
    laser, seen = Lost(), []
    interlock = LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0})
    supervisor = opened(laser, interlock, seen.append)
    arm(supervisor)
    enable(supervisor)
    laser.gone = True
    assert not supervisor.trip("camera/heartbeat reports stopped")
    assert seen[-1].readback.output is LaserOutput.UNKNOWN
    assert "switch the generator off by hand" in seen[-1].reason
    laser.gone = False
    wait_until(lambda: seen[-1].readback.output is LaserOutput.OFF, "the read-back")
    assert "switch the generator off by hand" not in seen[-1].reason
    supervisor.close()


class Failing(DelayedLaser):
    """Its driver fails at the command ``at`` with an error that no driver should raise."""

    at = ""

    def enable(self) -> None:
        super().enable()
        self._fail("enable")

    def configure(self, modulation: Modulation) -> None:
        super().configure(modulation)
        self._fail("configure")

    def disable(self) -> None:
        self._fail("disable")
        super().disable()

    def readback(self) -> LaserReadback:
        self._fail("readback")
        return super().readback()

    def _fail(self, command: str) -> None:
        if self.at == command:
            raise ValueError(f"{command} failed")


@pytest.fixture
def failing() -> Iterator[tuple[LaserSupervisor, Failing]]:
    laser = Failing()
    # Read back once an hour: the commands themselves must disable.
    supervisor = LaserSupervisor(
        LaserInterlock(10.0, 60.0, {}), running=lambda: True, publish=lambda _: None, alarm=print,
        log=print, readback_period_s=3600.0,
    )  # fmt: skip
    supervisor.open(laser, Modulation(70.0))
    arm(supervisor)
    yield supervisor, laser
    laser.at = ""
    supervisor.close()


@pytest.mark.parametrize("at", ["enable", "readback"])
def test_light_ends_when_enabling_fails_with_any_error(failing, at):
    supervisor, laser = failing
    laser.at = at
    with pytest.raises(ValueError, match=f"{at} failed"):
        enable(supervisor)
    assert not laser.lit
    assert supervisor.status().requested is LaserOutput.OFF
    assert supervisor.status().reason == f"{at} failed"


def test_light_ends_when_configuring_fails_with_any_error(failing):
    supervisor, laser = failing
    enable(supervisor)
    laser.at = "configure"
    with pytest.raises(ValueError, match="configure failed"):
        supervisor.configure(Modulation(80.0))
    assert not laser.lit
    assert supervisor.status().reason == "configure failed"


def test_output_is_unknown_when_disabling_fails_with_any_error(failing):
    supervisor, laser = failing
    enable(supervisor)
    laser.at = "disable"
    with pytest.raises(DeviceError, match="laser state unknown: disable failed"):
        supervisor.disable("switched off by request")
    assert supervisor.status().readback.output is LaserOutput.UNKNOWN
    assert not supervisor.trip("interlock open")


def test_arming_does_not_outlive_disabling(supervisor, laser):
    laser.delayed = "arm"
    failures: list[str] = []
    arming = in_thread(lambda: arm(supervisor), failures)
    assert laser.reached.wait(DEADLINE_S)
    supervisor.trip("interlock open")
    laser.go.set()
    arming.join()
    assert failures == ["laser refused: interlock open"]
    with pytest.raises(DeviceError, match="not armed"):
        enable(supervisor)
    assert laser.enablings == 0


def test_commands_that_waited_while_it_was_disabled_are_void(supervisor, laser):
    laser.delayed = "configure"
    supervisor._commands = turns = Turns()  # type: ignore[assignment]
    failures: list[str] = []
    begun = [in_thread(lambda: supervisor.configure(Modulation(80.0)), failures)]
    assert laser.reached.wait(DEADLINE_S)
    begun.append(in_thread(lambda: arm(supervisor), failures))
    begun.append(in_thread(lambda: enable(supervisor), failures))
    wait_until(lambda: turns.asked == 3, "all three waiting for their turn")
    supervisor.disable("switched off by request")
    laser.go.set()
    for thread in begun:
        thread.join()
    assert failures == ["laser refused: switched off by request"] * 2
    assert not supervisor.interlock.armed
    assert laser.enablings == 0


class Interrupted(DelayedLaser):
    """``enable`` lasts until ``disable`` interrupts it, which then lasts 50 ms longer."""

    def enable(self) -> None:
        self.reached.set()
        assert self.go.wait(DEADLINE_S)
        raise DeviceError("switched off meanwhile")

    def disable(self) -> None:
        super().disable()
        if self.reached.is_set() and not self.go.is_set():
            self.go.set()
            time.sleep(0.05)


def test_reason_is_that_of_the_disabling_not_of_the_command_it_interrupts(supervisor):
    laser = Interrupted()
    supervisor.close()
    supervisor.open(laser, Modulation(70.0))
    arm(supervisor)
    failures: list[str] = []
    enabling = in_thread(lambda: enable(supervisor), failures)
    assert laser.reached.wait(DEADLINE_S)
    supervisor.trip("interlock open")
    enabling.join()
    assert failures == ["switched off meanwhile"]
    assert supervisor.status().reason == "interlock open"


class DisabledByGuard(DelayedLaser):
    """With ``delayed`` a read-back ends as the guard disables the output."""

    def readback(self) -> LaserReadback:
        if self.delayed:
            self.delayed, self.lit = "", False
            raise VoidedError("laser refused: switched off meanwhile")
        return dataclasses.replace(super().readback(), reason="process 1 is stopped")


def test_a_read_back_that_the_guard_interrupts_is_no_failure_of_the_laser() -> None:
    laser, alarms = DisabledByGuard(), []
    interlock = LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0})
    supervisor = opened(laser, interlock, alarm=alarms.append)
    arm(supervisor)
    enable(supervisor)
    laser.delayed = "readback"
    wait_until(lambda: supervisor.status().requested is LaserOutput.OFF, "the laser disabled")
    supervisor.close()
    assert supervisor.switch_offs == 1
    assert alarms == []


def test_closing_disables_before_it_waits_for_a_check(laser, monkeypatch):
    monkeypatch.setattr(laser_supervisor, "_STOP_TIMEOUT_S", 10.0 * DEADLINE_S)
    supervisor = opened(laser, LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0}))
    arm(supervisor)
    enable(supervisor)
    laser.delayed = "readback"
    assert laser.reached.wait(DEADLINE_S)
    closing = in_thread(supervisor.close, [])
    # Sooner than the read-back, too, would give up.
    assert laser.disabled.wait(DEADLINE_S / 2)
    assert not laser.lit
    laser.go.set()
    closing.join()


def test_stall_of_this_process_leaves_light_on(monkeypatch):
    clock = StallClock(monkeypatch)
    laser = DelayedLaser()
    interlock = LaserInterlock(10.0, 600.0, {CLIENT_HEARTBEAT: 1.0}, now_s=clock.monotonic)
    supervisor = opened(laser, interlock)
    try:
        arm(supervisor)
        enable(supervisor)
        clock.advance(60.0)
        assert laser.lit
        for _ in range(22):
            clock.advance(0.05)
        assert not laser.lit
        assert "laser/heartbeat older than 1 s" in supervisor.status().reason
    finally:
        supervisor.close()


def test_opened_again_it_is_watched_once(supervisor, laser):
    laser.delayed = "readback"
    assert laser.reached.wait(DEADLINE_S)
    supervisor.close()
    laser.delayed = ""
    supervisor.open(DelayedLaser(), Modulation(70.0))
    laser.go.set()

    once = ["laser read-back", "laser watchdog"]

    def watching() -> list[str]:
        return sorted(thread.name for thread in threading.enumerate() if thread.name in once)

    wait_until(lambda: watching() == once, "the old one's end")


def test_a_publisher_that_never_returns_does_not_keep_light_on(laser):
    blocked, go = threading.Event(), threading.Event()
    seen: list[LaserStatus] = []

    def publish(status: LaserStatus) -> None:
        seen.append(status)
        if status.requested is LaserOutput.ON:
            blocked.set()
            assert go.wait(DEADLINE_S)

    interlock = LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0})
    supervisor = opened(laser, interlock, publish)
    arm(supervisor)
    failures: list[str] = []
    enabling = in_thread(lambda: enable(supervisor), failures)
    assert blocked.wait(DEADLINE_S)
    disabling = in_thread(lambda: supervisor.disable("switched off by request"), failures)
    disabling.join(DEADLINE_S)
    assert not disabling.is_alive()
    assert not laser.lit
    go.set()
    enabling.join()
    # What was reported meanwhile follows, in order.
    assert seen[-1].reason == "switched off by request"
    supervisor.close()


def test_a_status_that_cannot_be_published_ends_no_watchdog(laser):
    def publish(status: LaserStatus) -> None:
        if threading.current_thread().name == "laser watchdog":
            raise RuntimeError("no buffer")

    interlock = LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0}, contact_timeout_s=60.0)
    supervisor = opened(laser, interlock, publish)
    for _ in range(2):
        interlock.receive_contact(False)
        interlock.reset_contact([])
        arm(supervisor)
        enable(supervisor)
        assert laser.lit
        interlock.receive_contact(True)
        wait_until(lambda: supervisor.status().requested is LaserOutput.OFF, "the trip")
        assert not laser.lit
    supervisor.close()


def test_the_watchdog_of_a_laser_that_is_lit_runs_no_callback_of_another_thread(laser):
    begun: list[str] = []

    def publish(status: LaserStatus) -> None:
        if status.requested is LaserOutput.ON:
            begun.append(threading.current_thread().name)

    interlock = LaserInterlock(10.0, 60.0, {CLIENT_HEARTBEAT: 60.0})
    supervisor = opened(laser, interlock, publish)
    arm(supervisor)
    enable(supervisor)
    end_s = time.monotonic() + 1.0
    while time.monotonic() < end_s:
        supervisor.report()
    supervisor.close()
    assert len(begun) > 100
    assert "laser watchdog" not in begun
