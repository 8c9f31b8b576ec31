"""What the keeper does when commands, switching off and the generator's answers cross; no ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest
from held_laser import HeldLaser

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.nodes.laser_gate import LEASE, LaserGate
from eschorty_ros.nodes.laser_keeper import LaserKeeper


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
    assert laser.reached.wait(5.0)
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
    failures: list[str] = []
    begun = [in_thread(lambda: keeper.configure(Modulation(80.0)), failures)]
    assert laser.reached.wait(5.0)
    begun.append(in_thread(keeper.arm, failures))
    begun.append(in_thread(keeper.enable, failures))
    time.sleep(0.1)
    keeper.switch_off("switched off by request")
    laser.go.set()
    for thread in begun:
        thread.join()
    assert failures == ["laser refused: switched off by request"] * 2
    assert not keeper.gate.armed
    assert laser.lightings == 0


def test_opened_again_it_is_watched_once(keeper: LaserKeeper, laser: HeldLaser) -> None:
    laser.hold = "readback"
    assert laser.reached.wait(5.0)
    keeper.close()
    laser.hold = ""
    keeper.open(HeldLaser(), Modulation(70.0))
    laser.go.set()
    time.sleep(0.2)
    named = [thread.name for thread in threading.enumerate() if thread.name.startswith("laser ")]
    assert sorted(named) == ["laser read-back", "laser watchdog"]
