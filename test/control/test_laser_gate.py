"""When the laser may be on, without ROS: arming, leases, interlock, longest time."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator

import pytest

from eschorty_ros.control.laser_interlock import LEASE, LaserGate
from eschorty_ros.control.peer import Peer, own_sign, place, read_sign

CAMERA = "camera/heartbeat"


class Clock:
    """A steady clock that is set by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def gate(clock: Clock) -> LaserGate:
    return LaserGate(10.0, 600.0, {LEASE: 1.0, CAMERA: 2.0}, now_s=clock)


@pytest.fixture
def peer() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(["sleep", "60"])
    yield process
    process.kill()
    process.wait()


def light(gate: LaserGate, sign: str = "") -> None:
    gate.beat(LEASE, sign)
    gate.beat(CAMERA)
    gate.arm()
    assert gate.refusal() is None
    gate.switched_on()
    assert gate.must_end() is None


def test_refusals_name_what_is_missing(gate: LaserGate, clock: Clock) -> None:
    assert "not armed" in str(gate.refusal())
    gate.arm()
    assert "no laser/heartbeat" in str(gate.refusal())
    gate.beat()
    assert "no camera/heartbeat" in str(gate.refusal())
    gate.beat(CAMERA)
    assert gate.refusal() is None
    gate.interlock_open = True
    assert "interlock open" in str(gate.refusal())
    clock.now_s += 10.5
    assert "expired after 10 s" in str(gate.refusal())


def test_a_required_interlock_is_open_unless_it_says_closed_again_and_again(clock: Clock) -> None:
    gate = LaserGate(10.0, 60.0, {}, interlock_timeout_s=1.0, now_s=clock)
    gate.arm()
    assert "interlock open" in str(gate.refusal())
    gate.interlock_open = False
    assert gate.refusal() is None
    gate.switched_on()
    clock.now_s += 0.99
    assert gate.must_end() is None
    clock.now_s += 0.02
    assert "interlock open" in str(gate.must_end())
    gate.interlock_open = False
    assert gate.must_end() is None
    gate.interlock_open = True
    assert "interlock open" in str(gate.must_end())


def test_each_lease_ends_at_its_own_age(gate: LaserGate, clock: Clock) -> None:
    light(gate)
    clock.now_s += 0.99
    assert gate.must_end() is None
    clock.now_s += 0.02
    assert "laser/heartbeat older than 1 s" in str(gate.must_end())
    gate.beat()
    assert gate.must_end() is None
    clock.now_s += 1.0
    gate.beat()
    assert "camera/heartbeat older than 2 s" in str(gate.must_end())


def test_time_on_is_bounded(gate: LaserGate, clock: Clock) -> None:
    light(gate)
    for _ in range(601):
        clock.now_s += 1.0
        gate.beat()
        gate.beat(CAMERA)
    assert "max_on_time" in str(gate.must_end())
    gate.switched_off()
    assert gate.must_end() is None
    assert not gate.armed


@pytest.mark.parametrize(
    ("number", "what"), [(signal.SIGKILL, "is dead"), (signal.SIGSTOP, "is stopped")]
)
def test_peer_on_this_host_is_seen_to_die(
    gate: LaserGate, peer: subprocess.Popen[bytes], number: int, what: str
) -> None:
    light(gate, f"{place()} {peer.pid}")
    peer.send_signal(number)
    os.waitid(os.P_PID, peer.pid, os.WEXITED | os.WSTOPPED | os.WNOWAIT)
    assert f"process {peer.pid} {what}" in str(gate.must_end())


def test_peer_elsewhere_is_trusted_until_its_lease_ends(gate: LaserGate) -> None:
    light(gate, "elsewhere/1 999999999")


def test_last_beat_ends_light_unless_somebody_else_beats(gate: LaserGate) -> None:
    light(gate, own_sign(stopped=False))
    gate.beat(LEASE, "elsewhere/1 17 stopped")
    assert gate.must_end() is None
    gate.beat(LEASE, own_sign(stopped=True))
    assert "says stopped" in str(gate.must_end())
    gate.beat(LEASE, own_sign(stopped=False))
    assert gate.must_end() is None


def test_signs_are_read_back() -> None:
    own = Peer(place(), os.getpid())
    assert read_sign(own_sign(stopped=False)) == (own, False)
    assert read_sign(own_sign(stopped=True)) == (own, True)
    assert own.trouble() == ""
    for text in ("", "camera", "a b c d", "host x", "host 1 started"):
        assert read_sign(text) == (None, False)


def test_a_pause_of_the_watcher_ages_no_beat(gate: LaserGate, clock: Clock) -> None:
    light(gate)
    clock.now_s += 0.7
    gate.beat(CAMERA)
    clock.now_s += 5.0
    gate.forgive(5.0)
    assert gate.must_end() is None
    clock.now_s += 0.4
    assert "laser/heartbeat older than 1 s" in str(gate.must_end())
    gate.beat()
    # Heard after the pause, before it is noticed: not dated ahead.
    gate.forgive(5.0)
    clock.now_s += 1.1
    assert "laser/heartbeat older than 1 s" in str(gate.must_end())


def test_a_pause_that_begins_after_the_look_ages_no_beat_either(
    gate: LaserGate, clock: Clock
) -> None:
    light(gate)
    looked_s = clock.now_s
    clock.now_s += 5.0
    assert gate.must_end(looked_s) is None
    gate.forgive(5.0)
    assert gate.must_end(clock.now_s) is None


def test_a_pause_of_the_watcher_lengthens_no_light(gate: LaserGate, clock: Clock) -> None:
    light(gate)
    clock.now_s += 601.0
    gate.forgive(601.0)
    assert "max_on_time" in str(gate.must_end())
