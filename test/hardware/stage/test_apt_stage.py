"""The stage driver on the emulated controller, in virtual time."""

import random
from dataclasses import replace

import numpy as np
import pytest
from apt_bench import EPOCH_NS, SUSPENSION_NS, AptBench

from eschorty_ros.core.base.errors import ArgumentError, DeviceError
from eschorty_ros.core.clocks import ClockLine, StageTrack, fit_edges
from eschorty_ros.hardware.stage.apt_setup import AptSettings

BAY_2 = AptSettings(controller="bbd30x", bay=2, trigger_port=3)


@pytest.fixture
def bench() -> AptBench:
    return AptBench()


@pytest.mark.parametrize("settings", [AptSettings(), BAY_2], ids=["kbd101", "bbd30x"])
def test_connect_home_and_move(settings: AptSettings) -> None:
    bench = AptBench(settings)
    stage = bench.stage
    assert stage.identity.model.endswith("with DDS220")
    assert stage.travel_mm == (0.0, 220.0)
    assert stage.speed_max_mm_s == pytest.approx(250.0, abs=1e-3)
    assert stage.acceleration_mm_s2 == pytest.approx(2000.0, abs=0.1)
    for target_mm in (100.0, 220.0, 0.0, 33.33335):
        bench.move(target_mm)
        state = stage.state()
        assert state.position_mm == pytest.approx(target_mm, abs=5e-5)
        assert bench.true_mm == pytest.approx(target_mm, abs=5e-5)
        assert state.velocity_mm_s == 0.0
        assert {"homed", "enabled", "settled"} <= set(state.flags)
    assert stage.healthy


def test_caps_are_the_least_of_settings_and_report() -> None:
    slow = AptBench(speed_max_mm_s=120.0, acceleration_max_mm_s2=900.0, home=False).stage
    assert slow.speed_max_mm_s == pytest.approx(120.0, abs=1e-3)
    assert slow.acceleration_mm_s2 == pytest.approx(900.0, abs=0.1)
    settings = AptSettings(speed_max_mm_s=300.0, travel_mm=(10.0, 90.0))
    fast = AptBench(settings, speed_max_mm_s=400.0, acceleration_max_mm_s2=5000.0, home=False).stage
    assert fast.speed_max_mm_s == 300.0
    assert fast.acceleration_mm_s2 == 2000.0
    assert fast.travel_mm == (10.0, 90.0)


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
def test_odometry_within_20_um_at_300_mm_s(rate_hz: float) -> None:
    """With jitter of the answers, the line's own time, polling and ramps."""
    chance = random.Random(5)
    bench = AptBench(
        AptSettings(speed_max_mm_s=300.0, poll_hz=rate_hz),
        speed_max_mm_s=300.0,
        late_ns=lambda: round(chance.uniform(0.0, 3e6)),
    )
    bench.move(5.0, 300.0)
    found: dict[int, float] = {}
    for target_mm in (215.0, 5.0):
        bench.stage.move_to(target_mm, 300.0)
        while bench.stage.state().moving:
            bench.advance(0.01)
            state = bench.stage.state()
            found[state.t_ns] = state.position_mm
    places = np.array(list(found.values()))
    true = np.array([bench.model.axis.position_mm(t_ns) for t_ns in found])
    worst_um = np.abs(places - true).max() * 1e3
    print(f"{rate_hz:g} Hz: {worst_um:.1f} um at most, {len(found)} positions")
    assert np.ptp(true) > 205.0
    assert worst_um < 20.0
    assert bench.stage.statistics()["fit_residual_um"] < 5.0


@pytest.mark.parametrize("halt_ms", [0, 60, 150, 280])
@pytest.mark.parametrize("late_ms", [0.0, 10.0])
def test_odometry_waits_for_a_motion_that_begins_late(halt_ms: int, late_ms: float) -> None:
    """No position is reported that the next reading contradicts, and none waits for the end."""
    bench = AptBench(late_ns=lambda: round(late_ms * 1e6))
    bench.move(19.3)
    bench.stage.move_to(60.0, 50.0)
    begun_ns = bench.now_ns
    bench.halted_until_ns = begun_ns + halt_ms * 1_000_000
    found: dict[int, float] = {}
    behind_ms = 0.0
    while bench.stage.state().moving:
        bench.advance(0.01)
        state = bench.stage.state()
        found[state.t_ns] = state.position_mm
        if bench.now_ns > bench.halted_until_ns + 50_000_000:
            behind_ms = max(behind_ms, (bench.clock_ns() - state.t_ns) * 1e-6)
    true = np.array([bench.model.axis.position_mm(t_ns) for t_ns in found])
    worst_mm = np.abs(np.array(list(found.values())) - true).max()
    print(f"{halt_ms} ms, answers {late_ms:g} ms late: off by {worst_mm:.3f} mm at most, "
          f"{behind_ms:.0f} ms behind after the halt")  # fmt: skip
    assert worst_mm < 0.3
    assert behind_ms < 130.0


def test_a_suspended_reader_does_not_look_like_a_clock_that_was_set() -> None:
    """The thread may stop for long between the receipt of a status and the reading of a clock."""
    bench = AptBench()
    bench.stage.move_to(100.0, 100.0)
    bench.advance(0.3)
    t_ns = bench.clock_ns() + SUSPENSION_NS // 2
    # The clock is read at each request and at each receipt in turn.
    bench.suspensions = 2
    bench.advance(2.0)
    assert bench.suspensions == 0
    assert bench.stage.statistics()["clock_sets"] == 0
    state = bench.stage.state(t_ns)
    assert state.t_ns == t_ns
    assert state.position_mm == pytest.approx(bench.model.axis.position_mm(t_ns), abs=0.05)


def test_moves_are_refused_with_a_reason() -> None:
    bench = AptBench(home=False)
    with pytest.raises(DeviceError, match="not homed"):
        bench.stage.move_to(10.0, 100.0)
    bench = AptBench()
    for position_mm, speed_mm_s, reason in (
        (221.0, 100.0, "travel is 0 to 220"),
        (-1.0, 100.0, "travel is 0 to 220"),
        (10.0, 260.0, "choose above 0 to 250"),
        (10.0, 0.0, "choose above 0"),
    ):
        with pytest.raises(DeviceError, match=reason):
            bench.stage.move_to(position_mm, speed_mm_s)
    bench.stage.move_to(200.0, 50.0)
    with pytest.raises(DeviceError, match="is moving"):
        bench.stage.move_to(10.0, 100.0)
    with pytest.raises(DeviceError, match="is moving"):
        bench.stage.home()


def test_homing_waits_for_the_search_of_the_phase(bench: AptBench) -> None:
    """The axis is enabled and rests now and then while the controller takes no order."""
    bench.model.reboot()
    bench.model.extra_bits = 0x0800
    begun_ns = bench.now_ns

    def search() -> None:
        if bench.now_ns > begun_ns + 4_000_000_000:
            bench.model.extra_bits = 0

    bench.on_tick = search
    bench.stage = bench.open()
    assert bench.now_ns > begun_ns + 4_000_000_000
    bench.stage.home()
    bench.until(lambda: bench.stage.state().homed, 30.0)


def test_profiled_stop_is_on_the_wire_at_once() -> None:
    """The line is busy with polling at 200 Hz and a queue of requests."""
    bench = AptBench(AptSettings(poll_hz=200.0))
    bench.stage.move_to(200.0, 100.0)
    bench.advance(0.5)
    for _ in range(50):
        bench.stage._setup.send("request_velocity")
    asked_ns = bench.now_ns
    bench.stage.stop()
    assert bench.sent(0x0465)[-1] - asked_ns < 20_000_000
    bench.until(lambda: not bench.stage.state().moving)
    assert 45.0 < bench.stage.state().position_mm < 60.0
    assert bench.stage.state().position_mm == pytest.approx(bench.true_mm, abs=1e-4)
    bench.move(10.0)


def test_a_stop_while_a_move_is_prepared_prevents_it(bench: AptBench) -> None:
    """The speed is written before the move is ordered; that takes its time."""
    at_mm = bench.true_mm
    bench.on_tick = lambda: bench.stage.stop() if bench.sent(0x0413)[before:] else None
    before = len(bench.sent(0x0413))
    with pytest.raises(DeviceError, match="stopped before the move began"):
        bench.stage.move_to(100.0, 90.0)
    bench.on_tick = lambda: None
    bench.advance(0.5)
    assert bench.true_mm == at_mm
    bench.move(20.0)


def test_a_move_that_a_stop_crosses_ends_too(bench: AptBench) -> None:
    before_mm = bench.true_mm
    orders = len(bench.sent(0x0453))
    send = bench.stage._send_stop

    def crossed() -> None:
        send()
        bench.stage._send_stop = send
        bench.stage.move_to(100.0, 90.0)

    bench.stage._send_stop = crossed
    bench.stage.stop()
    assert len(bench.sent(0x0453)) == orders + 1
    bench.until(lambda: not bench.stage.state().moving)
    assert abs(bench.true_mm - before_mm) < 1.0


def test_a_stage_left_moving_is_stopped_at_connect(bench: AptBench) -> None:
    bench.stage.move_to(200.0, 50.0)
    bench.advance(0.5)
    bench.stage = bench.open()
    assert not bench.stage.state(bench.clock_ns()).moving or bench.true_mm < 60.0
    bench.advance(0.3)
    assert not bench.stage.state().moving
    bench.move(20.0)


@pytest.mark.parametrize("settings", [AptSettings(), BAY_2], ids=["kbd101", "bbd30x"])
def test_pulses_every_2_mm_in_both_directions(settings: AptSettings) -> None:
    bench = AptBench(settings)
    pulses = bench.stage.trigger
    assert pulses is not None
    assert (pulses.first_mm, pulses.interval_mm, pulses.count) == (2.0, 2.0, 109)
    expected = [2.0 * (k + 1) for k in range(109)]
    assert pulses_of_move(bench, 220.0) == pytest.approx(expected, abs=1e-3)
    assert pulses_of_move(bench, 0.0) == pytest.approx(expected[::-1], abs=1e-3)
    rising = [up for _, up in bench.model.trigger_pulses(EPOCH_NS, bench.clock_ns())]
    assert rising == [True, False] * (2 * 109)


def pulses_of_move(bench: AptBench, target_mm: float) -> list[float]:
    """Return the positions of the pulses that a move gives."""
    begun_ns = bench.clock_ns()
    bench.move(target_mm)
    edges = bench.model.trigger_pulses(begun_ns, bench.clock_ns())
    return [bench.model.axis.position_mm(t_ns) for t_ns, rising in edges if rising]


@pytest.mark.parametrize("settings", [AptSettings(), BAY_2], ids=["kbd101", "bbd30x"])
def test_every_sweep_over_a_part_of_the_travel_gives_all_its_pulses(settings: AptSettings) -> None:
    """The pulses at the ends themselves are left out: the carriage may tremble across them."""
    bench = AptBench(settings)
    bench.move(10.0)
    places = [12.0 + 2.0 * k for k in range(24)]
    for _ in range(3):
        assert pulses_of_move(bench, 60.0) == pytest.approx(places, abs=1e-3)
        assert pulses_of_move(bench, 10.0) == pytest.approx(places[::-1], abs=1e-3)
    assert pulses_of_move(bench, 11.0) == []
    assert pulses_of_move(bench, 11.5) == []
    assert pulses_of_move(bench, 12.5) == pytest.approx([12.0], abs=1e-3)


def test_pulses_of_sweeps_forth_and_back_give_the_clock() -> None:
    """By the odometry, and by all positions at which moves may give pulses."""
    bench = AptBench(sampled_pulses=True)
    bench.move(10.0)
    begun_ns = bench.clock_ns()
    track = StageTrack()
    for target_mm in (60.0, 10.0, 60.0):
        bench.stage.move_to(target_mm, 100.0)
        while bench.stage.state().moving:
            bench.advance(0.01)
            state = bench.stage.state()
            track.append([state.t_ns // 1000], [state.position_mm])
    edges = bench.model.trigger_pulses(begun_ns, bench.clock_ns())
    rises_us = np.array([t_ns - EPOCH_NS for t_ns, rising in edges if rising]) // 1000
    late = ClockLine(0, EPOCH_NS + 7_000_000)
    fit = fit_edges(rises_us, track, bench.stage.trigger, late)
    assert (fit.used, fit.missing, fit.spurious) == (3 * 24, 0, 0)
    error_us = (fit.line.to_ns(rises_us) - EPOCH_NS) // 1000 - rises_us
    assert np.abs(error_us).max() < 100


def test_a_sweep_after_one_that_was_stopped_gives_all_its_pulses(bench: AptBench) -> None:
    bench.stage.move_to(200.0, 100.0)
    bench.advance(0.5)
    bench.stage.stop()
    bench.until(lambda: not bench.stage.state().moving)
    before_mm = bench.true_mm
    places = [place for place in np.arange(2.0, before_mm, 2.0) if place > 10.0]
    assert pulses_of_move(bench, 10.0) == pytest.approx(places[::-1], abs=1e-3)


def test_homing_gives_no_pulses() -> None:
    bench = AptBench(home=False, power_up_mm=150.0)
    bench.stage.home()
    bench.until(lambda: bench.stage.state().homed, 30.0)
    assert bench.model.trigger_pulses(EPOCH_NS, bench.clock_ns()) == []


def test_sampled_pulses_are_late_by_one_cycle_at_most() -> None:
    bench = AptBench(sampled_pulses=True)
    begun_ns = bench.clock_ns()
    bench.move(100.0, 100.0)
    rises = [t for t, up in bench.model.trigger_pulses(begun_ns, bench.clock_ns()) if up]
    late_mm = [bench.model.axis.position_mm(t) - 2.0 * (k + 1) for k, t in enumerate(rises)]
    assert min(late_mm) >= -1e-6
    assert max(late_mm) <= 100.0 * 102.4e-6
    assert max(late_mm) > 1e-3


def test_no_pulses_when_the_interval_is_0() -> None:
    bench = AptBench(AptSettings(trigger_interval_mm=0.0))
    assert bench.stage.trigger is None
    bench.move(50.0)
    assert bench.model.trigger_pulses(EPOCH_NS, bench.clock_ns()) == []


def test_all_settings_are_written_at_each_connection(bench: AptBench) -> None:
    bench.model.reboot()
    bench.port.written.clear()
    bench.stage = bench.open()
    for id in (0x0210, 0x0413, 0x0440, 0x04E3, 0x0523, 0x0526):
        assert bench.sent(id), hex(id)


def test_the_controller_gets_the_address_of_the_host_before_any_order(bench: AptBench) -> None:
    ids = [data[:2].hex() for _, data in bench.port.written]
    assert ids[:3] == ["9204", "1800", "1200"]


@pytest.mark.parametrize("reserved_bytes", [0, 12])
def test_answers_about_the_trigger_have_either_length(reserved_bytes: int) -> None:
    bench = AptBench(reserved_bytes=reserved_bytes)
    begun_ns = bench.clock_ns()
    bench.move(20.0)
    assert len(bench.model.trigger_pulses(begun_ns, bench.clock_ns())) > 10
    assert bench.stage.statistics()["skipped_bytes"] == 0


@pytest.mark.parametrize("name", ["set_ports", "set_pulses", "set_rack_trigger"])
def test_a_trigger_that_the_controller_refuses_is_named(name: str) -> None:
    bench = AptBench(BAY_2 if "rack" in name else None, home=False)
    bench.model.reboot()
    bench.model.ignored = {name}
    with pytest.raises(DeviceError, match=r"keeps trigger \w+ \d+ instead of \d+; set trigger_int"):
        bench.open()
    bench.settings = replace(bench.settings, trigger_interval_mm=0.0)
    bench.open()


def test_a_mute_controller_and_an_empty_bay_are_named() -> None:
    bench = AptBench(home=False)
    bench.model.mute = True
    with pytest.raises(DeviceError, match=r"sent no 'info'.*check its power"):
        bench.open()
    bench = AptBench(BAY_2, home=False)
    bench.settings = AptSettings(controller="bbd30x", bay=3)
    with pytest.raises(DeviceError, match="bay 3 of the rack is empty"):
        bench.open()


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"controller": "tdc001"}, "controller is 'tdc001'"),
        ({"bay": 11}, "bay is 11"),
        ({"poll_hz": 0.0}, "poll_hz is 0.0"),
        ({"trigger_port": 3}, "trigger_port is 3"),
        ({"trigger_interval_mm": -1.0}, "trigger_interval_mm is -1.0"),
    ],
)
def test_wrong_settings_are_refused(wrong: dict, text: str) -> None:
    with pytest.raises(ArgumentError, match=text):
        AptSettings(**wrong)


@pytest.mark.parametrize("set_s", [-2, -3600, 3600])
@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
def test_the_odometry_continues_after_the_host_clock_is_set(
    bench: AptBench, set_s: int, moving: bool
) -> None:
    bench.move(10.0)
    if moving:
        bench.stage.move_to(110.0, 100.0)
        bench.advance(0.3)
    bench.clock_set_ns = set_s * 1_000_000_000
    bench.advance(0.3)
    state = bench.stage.state()
    assert abs(state.t_ns - bench.host_clock_ns()) < 200_000_000
    true_mm = bench.model.axis.position_mm(state.t_ns - bench.clock_set_ns)
    # In a move the position comes from readings alone, which are as late as the line.
    assert state.position_mm == pytest.approx(true_mm, abs=0.3 if moving else 1e-4)
    bench.until(lambda: not bench.stage.state().moving, 5.0)
    bench.move(40.0)
    assert bench.stage.state().position_mm == pytest.approx(40.0, abs=5e-5)
    assert bench.stage.healthy


def test_a_stage_at_rest_is_polled_less_and_its_states_are_no_older():
    bench = AptBench()
    bench.advance(0.5)

    def readings_in(seconds: float) -> float:
        before = bench.stage.statistics()["frames"]
        bench.advance(seconds)
        return bench.stage.statistics()["frames"] - before

    assert 15 <= readings_in(1.0) <= 20
    assert bench.host_clock_ns() - bench.stage.state().t_ns <= bench.stage.lag_s * 1e9
    bench.stage.move_to(100.0, 50.0)
    assert readings_in(1.0) >= 45
