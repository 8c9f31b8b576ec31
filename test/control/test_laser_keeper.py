"""What the keeper does when commands, switching off and the generator's answers cross; no ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest
from held_laser import HeldLaser
from hours import Hours
from waiting import DEADLINE_S, wait_until

from eschorty_ros.control.laser_interlock import LEASE, LaserGate
from eschorty_ros.control.laser_supervisor import LaserKeeper
from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.modulation import Modulation


@pytest.fixture
def laser() -> Iterator[HeldLaser]:
    made = HeldLaser()
    yield made
    made.go.set()


@pytest.fixture
def keeper(laser: HeldLaser) -> Iterator[LaserKeeper]:
    made = LaserKeeper(
        LaserGate(10.0, 60.0, {LEASE: 60.0}),
        living=lambda: True,
        changed=lambda snapshot: None,
        alarm=print,
        log=print,
        readback_period_s=0.02,
    )
    made.gate.beat()
    made.open(laser, Modulation(70.0))
    yield made
    laser.go.set()
    made.close()


class Turns:
    """A lock that counts who has asked for it."""

    def __init__(self) -> None:
        self.asked = 0
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self.asked += 1
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def in_thread(step: Callable[[], None], failures: list[str]) -> threading.Thread:
    def attempt() -> None:
        try:
            step()
        except DeviceError as error:
            failures.append(str(error))

    thread = threading.Thread(target=attempt)
    thread.start()
    return thread


def test_asked_for_light_again_it_stays_on(keeper: LaserKeeper, laser: HeldLaser) -> None:
    keeper.arm()
    keeper.enable()
    keeper.enable()
    assert laser.lit
    assert laser.lightings == 1


def test_arming_does_not_outlive_a_switching_off(keeper: LaserKeeper, laser: HeldLaser) -> None:
    laser.hold = "arm"
    failures: list[str] = []
    arming = in_thread(keeper.arm, failures)
    assert laser.reached.wait(DEADLINE_S)
    keeper.darken("interlock open")
    laser.go.set()
    arming.join()
    assert failures == ["laser refused: interlock open"]
    with pytest.raises(DeviceError, match="not armed"):
        keeper.enable()
    assert laser.lightings == 0


def test_what_waited_while_it_was_switched_off_is_void(
    keeper: LaserKeeper, laser: HeldLaser
) -> None:
    laser.hold = "configure"
    keeper._commands = turns = Turns()  # type: ignore[assignment]
    failures: list[str] = []
    begun = [in_thread(lambda: keeper.configure(Modulation(80.0)), failures)]
    assert laser.reached.wait(DEADLINE_S)
    begun.append(in_thread(keeper.arm, failures))
    begun.append(in_thread(keeper.enable, failures))
    wait_until(lambda: turns.asked == 3, "all three waiting for their turn")
    keeper.switch_off("switched off by request")
    laser.go.set()
    for thread in begun:
        thread.join()
    assert failures == ["laser refused: switched off by request"] * 2
    assert not keeper.gate.armed
    assert laser.lightings == 0


class Interrupted(HeldLaser):
    """``enable`` is under way until switching off interrupts it, which goes on for a moment."""

    def enable(self) -> None:
        self.reached.set()
        assert self.go.wait(DEADLINE_S)
        raise DeviceError("interrupted by switching off")

    def disable(self) -> None:
        super().disable()
        if self.reached.is_set() and not self.go.is_set():
            self.go.set()
            time.sleep(0.05)


def test_the_reason_is_that_of_whoever_switched_off(keeper: LaserKeeper) -> None:
    laser = Interrupted()
    keeper.close()
    keeper.open(laser, Modulation(70.0))
    keeper.arm()
    failures: list[str] = []
    enabling = in_thread(keeper.enable, failures)
    assert laser.reached.wait(DEADLINE_S)
    keeper.darken("interlock open")
    enabling.join()
    assert failures == ["interrupted by switching off"]
    snapshot = keeper.snapshot()
    assert snapshot is not None
    assert snapshot.reason == "interlock open"


def test_a_pause_of_the_watcher_leaves_light_on(monkeypatch: pytest.MonkeyPatch) -> None:
    hours = Hours(monkeypatch)
    laser = HeldLaser()
    gate = LaserGate(10.0, 600.0, {LEASE: 1.0}, now_s=hours.monotonic)
    keeper = LaserKeeper(
        gate,
        living=lambda: True,
        changed=lambda snapshot: None,
        alarm=print,
        log=print,
        readback_period_s=0.02,
    )
    gate.beat()
    keeper.open(laser, Modulation(70.0))
    try:
        keeper.arm()
        keeper.enable()
        hours.pass_by(60.0)
        assert laser.lit
        for _ in range(22):
            hours.pass_by(0.05)
        assert not laser.lit
        snapshot = keeper.snapshot()
        assert snapshot is not None
        assert "laser/heartbeat older than 1 s" in snapshot.reason
    finally:
        keeper.close()


def test_opened_again_it_is_watched_once(keeper: LaserKeeper, laser: HeldLaser) -> None:
    laser.hold = "readback"
    assert laser.reached.wait(DEADLINE_S)
    keeper.close()
    laser.hold = ""
    keeper.open(HeldLaser(), Modulation(70.0))
    laser.go.set()

    once = ["laser read-back", "laser watchdog"]

    def watching() -> list[str]:
        return sorted(thread.name for thread in threading.enumerate() if thread.name in once)

    wait_until(lambda: watching() == once, "the old one's end")
