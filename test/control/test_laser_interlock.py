"""When the laser may be on: arming, contact, heartbeats, longest time on."""

import os
import signal
import subprocess
import threading
from collections.abc import Iterator

import pytest

from eschorty_ros.control.heartbeat import heartbeat_text, place
from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT, LaserInterlock

CAMERA = "camera/heartbeat"


class Clock:
    """A steady clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def interlock(clock: Clock) -> LaserInterlock:
    return LaserInterlock(10.0, 600.0, {CLIENT_HEARTBEAT: 1.0, CAMERA: 2.0}, now_s=clock)


@pytest.fixture
def sender() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(["sleep", "60"])
    yield process
    process.kill()
    process.wait()


def light(interlock: LaserInterlock, text: str = "") -> None:
    interlock.receive_heartbeat(CLIENT_HEARTBEAT, text)
    interlock.receive_heartbeat(CAMERA)
    interlock.arm()
    assert interlock.refusal() is None
    interlock.note_enabled()
    assert interlock.trip_reason() is None


def test_refusals_name_what_is_missing(interlock, clock):
    assert "not armed" in str(interlock.refusal())
    interlock.arm()
    assert "no laser/heartbeat" in str(interlock.refusal())
    interlock.receive_heartbeat()
    assert "no camera/heartbeat" in str(interlock.refusal())
    interlock.receive_heartbeat(CAMERA)
    assert interlock.refusal() is None
    interlock.receive_contact(True)
    assert "interlock open" in str(interlock.refusal())
    clock.now_s += 10.5
    assert "expired after 10 s" in str(interlock.refusal())


def test_required_contact_is_open_unless_it_is_reported_closed_repeatedly(clock):
    interlock = LaserInterlock(10.0, 60.0, {}, contact_required=True, now_s=clock)
    interlock.arm()
    assert "interlock open" in str(interlock.refusal())
    interlock.receive_contact(False)
    assert interlock.refusal() is None
    interlock.note_enabled()
    clock.now_s += 0.99
    assert interlock.trip_reason() is None
    clock.now_s += 0.02
    assert "interlock open" in str(interlock.trip_reason())
    interlock.receive_contact(False)
    assert interlock.trip_reason() is None
    interlock.receive_contact(True)
    assert "interlock open" in str(interlock.trip_reason())


def test_a_source_whose_name_is_discovered_later_is_one_source(clock):
    interlock = LaserInterlock(10.0, 60.0, {}, now_s=clock)
    interlock.receive_contact(True, "0a1b", "0a1b")
    interlock.receive_contact(True, "door", "0a1b")
    assert "interlock open (door)" in interlock.contact_fault()
    interlock.receive_contact(False, "door", "0a1b")
    assert not interlock.reset_contact(())
    assert not interlock.contact_open


def test_an_ended_source_that_never_had_a_name_does_not_stay_open_for_ever(clock):
    interlock = LaserInterlock(10.0, 60.0, {}, now_s=clock)
    interlock.receive_contact(True, "0a1b", unnamed="0a1b")
    interlock.receive_contact(True, "/door")
    interlock.receive_contact(False, "/door")
    assert "interlock open (0a1b)" in interlock.reset_contact({"0a1b", "2c3d"})
    assert interlock.contact_open
    interlock.receive_contact(True, "/door")
    assert "interlock open (/door)" in interlock.reset_contact({"2c3d"})
    interlock.receive_contact(False, "/door")
    assert interlock.contact_open
    assert interlock.reset_contact({"2c3d"}) == ""
    assert not interlock.contact_open


def test_every_source_must_be_closed_and_fresh_and_an_opened_one_reset(clock):
    interlock = LaserInterlock(10.0, 60.0, {}, now_s=clock)
    assert not interlock.contact_open
    interlock.receive_contact(True, "door")
    interlock.receive_contact(False, "lid")
    assert interlock.contact_fault() == "interlock open (door); close it"
    assert interlock.reset_contact(()) == "interlock open (door); close it"
    interlock.receive_contact(False, "door")
    assert "was opened (door); call laser/reset_interlock" in interlock.contact_fault()
    clock.now_s += 0.6
    interlock.receive_contact(False, "door")
    clock.now_s += 0.6
    assert "interlock open (lid): closed was last reported" in interlock.reset_contact(())
    interlock.receive_contact(False, "lid")
    assert interlock.contact_open
    assert interlock.reset_contact(()) == ""
    assert not interlock.contact_open
    # More sources than are kept: closed ones do not displace the others, an open one counts.
    for number in range(100):
        interlock.receive_contact(False, f"crowd {number}")
    interlock.receive_contact(True, "the last")
    assert interlock.reset_contact(()) == "interlock open (the last); close it"
    interlock.receive_contact(False, "the last")
    assert "was opened (the last)" in interlock.contact_fault()


def test_each_heartbeat_is_stale_at_its_own_age(interlock, clock):
    light(interlock)
    clock.now_s += 0.99
    assert interlock.trip_reason() is None
    clock.now_s += 0.02
    assert "laser/heartbeat older than 1 s" in str(interlock.trip_reason())
    interlock.receive_heartbeat()
    assert interlock.trip_reason() is None
    clock.now_s += 1.0
    interlock.receive_heartbeat()
    assert "camera/heartbeat older than 2 s" in str(interlock.trip_reason())


def test_time_on_is_bounded(interlock, clock):
    light(interlock)
    for _ in range(601):
        clock.now_s += 1.0
        interlock.receive_heartbeat()
        interlock.receive_heartbeat(CAMERA)
    assert "max_on_time" in str(interlock.trip_reason())
    interlock.note_disabled()
    assert interlock.trip_reason() is None
    assert not interlock.armed


@pytest.mark.parametrize(
    ("number", "what"), [(signal.SIGKILL, "is dead"), (signal.SIGSTOP, "is stopped")]
)
def test_death_of_a_sender_on_this_host_is_noticed(interlock, sender, number, what):
    light(interlock, f"{place()} {sender.pid}")
    sender.send_signal(number)
    os.waitid(os.P_PID, sender.pid, os.WEXITED | os.WSTOPPED | os.WNOWAIT)
    assert f"process {sender.pid} {what}" in str(interlock.trip_reason())


def test_sender_on_another_host_is_trusted_until_its_timeout(interlock):
    light(interlock, "elsewhere/1 999999999")


def test_reported_stop_trips_unless_it_is_of_another_sender(interlock):
    light(interlock, heartbeat_text(stopped=False))
    interlock.receive_heartbeat(CLIENT_HEARTBEAT, "elsewhere/1 17 stopped")
    assert interlock.trip_reason() is None
    interlock.receive_heartbeat(CLIENT_HEARTBEAT, heartbeat_text(stopped=True))
    assert "reports stopped" in str(interlock.trip_reason())
    interlock.receive_heartbeat(CLIENT_HEARTBEAT, heartbeat_text(stopped=False))
    assert interlock.trip_reason() is None


def test_an_opening_while_the_latch_is_reset_stays_latched():
    reports: list[threading.Thread] = []

    def now_s():
        """Return a constant; while the reset looks at the ages, another thread reports."""
        if reports and reports[0].ident is None:
            reports[0].start()
            reports[0].join(0.2)
        return 100.0

    interlock = LaserInterlock(10.0, 600.0, {}, now_s=now_s)

    def opens_and_closes():
        interlock.receive_contact(True, "door")
        interlock.receive_contact(False, "door")

    opens_and_closes()
    reports.append(threading.Thread(target=opens_and_closes))
    assert interlock.reset_contact(()) == ""
    reports[0].join(5.0)
    assert interlock.contact_fault() == "interlock was opened (door); call laser/reset_interlock"


def test_only_the_sender_that_had_it_enabled_keeps_the_light(interlock, clock):
    light(interlock, heartbeat_text(stopped=False))
    clock.now_s += 1.1
    interlock.receive_heartbeat(CAMERA)
    for number in range(100):
        interlock.receive_heartbeat(CLIENT_HEARTBEAT)
        interlock.receive_heartbeat(CLIENT_HEARTBEAT, heartbeat_text(stopped=False), f"{number}")
        interlock.receive_heartbeat(CAMERA, "", f"{number}")
    assert "laser/heartbeat older than 1 s" in str(interlock.trip_reason())
    assert interlock.foreign_heartbeats == 300
    interlock.receive_heartbeat(CLIENT_HEARTBEAT, heartbeat_text(stopped=False))
    assert interlock.trip_reason() is None
    interlock.note_disabled()
    interlock.arm()
    assert "senders at once" in str(interlock.refusal())


def test_stall_of_this_process_ages_no_heartbeat(interlock, clock):
    light(interlock)
    clock.now_s += 0.7
    interlock.receive_heartbeat(CAMERA)
    clock.now_s += 5.0
    interlock.exclude_stall(5.0)
    assert interlock.trip_reason() is None
    clock.now_s += 0.4
    assert "laser/heartbeat older than 1 s" in str(interlock.trip_reason())
    interlock.receive_heartbeat()
    # Received after the stall, before its measurement: not dated ahead.
    interlock.exclude_stall(5.0)
    clock.now_s += 1.1
    assert "laser/heartbeat older than 1 s" in str(interlock.trip_reason())


def test_stall_that_begins_after_its_measurement_ages_no_heartbeat_either(interlock, clock):
    light(interlock)
    measured_s = clock.now_s
    clock.now_s += 5.0
    assert interlock.trip_reason(measured_s) is None
    interlock.exclude_stall(5.0)
    assert interlock.trip_reason(clock.now_s) is None


def test_stall_of_this_process_does_not_extend_the_time_on(interlock, clock):
    light(interlock)
    clock.now_s += 601.0
    interlock.exclude_stall(601.0)
    assert "max_on_time" in str(interlock.trip_reason())
