"""The emulated stage controller, asked with thorlabs-apt-protocol's own frames."""

import io

import pytest
import thorlabs_apt_protocol as oracle

from eschorty_ros.emulation.apt.model import AptModel
from eschorty_ros.emulation.apt.wire import BYTE_NS
from eschorty_ros.hardware.stage import apt_messages as apt

UNIT, BAY_2, RACK = 0x50, 0x22, 0x11
SECOND = 1_000_000_000
ENABLE_AND_HOME = (oracle.mod_set_chanenablestate(UNIT, 1, 1, 1), oracle.mot_move_home(UNIT, 1, 1))
STATUS = oracle.mot_req_dcstatusupdate(UNIT, 1, 1)


class Host:
    """Frames to the model and back, in virtual time."""

    def __init__(self, **model: object) -> None:
        self.now_ns = 0
        self.model = AptModel(lambda: self.now_ns, **model)

    def ask(self, *frames: bytes, seconds: float = 0.1) -> list:
        """Return the answers within some time."""
        for frame in frames:
            self.model.feed(frame)
        data = b""
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns += 1_000_000
            data += self.model.step()
        return list(oracle.Unpacker(io.BytesIO(data)))


def test_identity_axis_and_status() -> None:
    info, axis, status = Host().ask(
        oracle.hw_req_info(UNIT, 1), oracle.mot_req_stageaxisparams(UNIT, 1, 1), STATUS
    )
    assert info.model_number.startswith(b"KBD101")
    assert axis.part_no_axis.startswith(b"DDS220")
    assert (axis.counts_per_unit, axis.max_pos) == (20_000, 4_400_000)
    assert status.position == 0
    assert not status.homed
    assert not status.channel_enabled


def test_rack_answers_for_its_bay_only() -> None:
    host = Host(controller="bbd30x", bay=2)
    bays = host.ask(*(oracle.rack_req_bayused(RACK, 1, bay) for bay in range(3)))
    assert [bay.occupied for bay in bays] == [False, True, False]
    assert host.ask(oracle.mot_req_dcstatusupdate(0x21, 1, 1)) == []
    (status,) = host.ask(oracle.mot_req_dcstatusupdate(BAY_2, 1, 1))
    assert status.source == BAY_2


def test_homing_and_a_move_follow_the_trapezoid() -> None:
    host = Host(power_up_mm=5.0)
    assert host.ask(oracle.mot_move_home(UNIT, 1, 1), seconds=1.0) == []
    (homed,) = host.ask(*ENABLE_AND_HOME, seconds=2.0)
    assert homed.msg == "mot_move_homed"
    velocity, acceleration = round(100 * 134_217.7), round(1000 * 13.744)
    ordered_ns = host.now_ns
    (moved,) = host.ask(
        oracle.mot_set_velparams(UNIT, 1, 1, 0, acceleration, velocity),
        oracle.mot_move_absolute(UNIT, 1, 1, 50 * 20_000),
        seconds=2.0,
    )
    assert moved.msg == "mot_move_completed"
    assert moved.position == 50 * 20_000
    plan = host.model.axis.plan
    assert 0 < plan.start_ns - ordered_ns < 6_000_000
    assert (plan.end_ns - plan.start_ns) * 1e-9 == pytest.approx(0.6, abs=1e-4)


def test_a_move_after_minutes_at_rest() -> None:
    host = Host()
    host.ask(*ENABLE_AND_HOME, seconds=2.0)
    host.now_ns += 600 * SECOND
    (moved,) = host.ask(oracle.mot_move_absolute(UNIT, 1, 1, 50 * 20_000), seconds=2.0)
    assert moved.msg == "mot_move_completed"
    assert host.model.axis.position_mm(host.now_ns) == pytest.approx(50.0)


class TriggeredHost(Host):
    """A homed host whose port 1 gives a sequence of position pulses in both directions."""

    def __init__(self, **pulses: int) -> None:
        super().__init__()
        self.ask(*ENABLE_AND_HOME, seconds=2.0)
        ports = {"mode_1": 0x0F, "polarity_1": 1, "mode_2": 0, "polarity_2": 1}
        self.ask(
            apt.pack("set_pulses", UNIT, width_us=50, **pulses),
            apt.pack("set_ports", UNIT, **ports),
        )

    def pulses(self, target_mm: float) -> list[float]:
        """Return the positions of the pulses that a move gives, mm."""
        begun_ns = self.now_ns
        position = round(target_mm * 20_000)
        self.ask(oracle.mot_move_absolute(UNIT, 1, 1, position), seconds=5.0)
        edges = self.model.trigger_pulses(begun_ns, self.now_ns)
        return [round(self.model.axis.position_mm(at), 2) for at, rising in edges if rising]


def test_pulses_of_the_manuals_example() -> None:
    host = TriggeredHost(
        start_forward=200_000,
        interval_forward=100_000,
        count_forward=2,
        start_reverse=240_000,
        interval_reverse=100_000,
        count_reverse=1,
        cycles=2,
    )
    for forth, back in (([10.0, 15.0], [12.0]), ([10.0, 15.0], [12.0]), ([], [])):
        assert host.pulses(20.0) == forth
        assert host.pulses(0.0) == back


def test_pulses_wait_for_a_position_that_is_not_passed() -> None:
    """A sequence over the whole travel is out of step after a sweep over a part of it."""
    host = TriggeredHost(
        start_forward=40_000,
        interval_forward=40_000,
        count_forward=109,
        start_reverse=4_360_000,
        interval_reverse=40_000,
        count_reverse=109,
        cycles=1_000_000,
    )
    assert host.pulses(61.0) == [2.0 * k for k in range(1, 31)]
    assert host.pulses(10.0) == []
    assert host.pulses(61.0) == []
    assert host.pulses(65.0) == [62.0, 64.0]


def test_it_sends_50_statuses_without_a_keep_alive_and_then_nothing() -> None:
    host = Host()
    assert len(host.ask(*[STATUS] * 60, seconds=1.0)) == 50
    assert host.ask(STATUS, oracle.hw_req_info(UNIT, 1)) == []
    assert len(host.ask(oracle.mot_ack_dcstatusupdate(UNIT, 1), STATUS)) == 1


def test_bytes_take_their_time_on_the_line() -> None:
    host = Host()
    host.model.feed(STATUS)
    host.now_ns = 26 * BYTE_NS - 1
    assert host.model.step() == b""
    host.now_ns += 1
    assert len(host.model.step()) == 20


def test_garbage_from_the_host_is_skipped() -> None:
    host = Host()
    (status,) = host.ask(b"\xff\xfe\xfd" + STATUS)
    assert status.position == 0


def test_a_restart_resets_everything() -> None:
    host = Host()
    host.ask(*ENABLE_AND_HOME, seconds=2.0)
    (status,) = host.ask(STATUS)
    assert status.homed
    host.model.reboot()
    (status,) = host.ask(STATUS)
    assert not status.homed
    assert not status.channel_enabled
