"""Faults of a stage on a serial line: what the driver does, what the user reads."""

import itertools
import random

import pytest
from apt_bench import AptBench

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.hardware.stage import apt_messages
from eschorty_ros.hardware.stage.apt_setup import AptSettings

DISCONNECT, STOP, KEEP_ALIVE = 0x0002, 0x0465, 0x0492


@pytest.fixture
def bench() -> AptBench:
    return AptBench()


@pytest.fixture
def moving(bench: AptBench) -> AptBench:
    """A bench half a second into a move to 200 mm."""
    bench.stage.move_to(200.0, 100.0)
    bench.advance(0.5)
    return bench


def stall(bench: AptBench, seconds: float) -> None:
    link, bench.link = bench.link, None
    bench.advance(seconds)
    bench.link = link


def at_rest(bench: AptBench) -> bool:
    bench.advance(0.5)
    return not bench.model.axis.moving(bench.clock_ns())


@pytest.mark.fault("garbage between frames")
def test_garbage_in_a_move_is_skipped(bench: AptBench) -> None:
    """driver: skips it and continues; user reads: skipped_bytes in the diagnostics."""
    chance = random.Random(1)
    bench.stage.move_to(200.0, 100.0)
    while bench.stage.state().moving:
        bench.model.disturbance.garbage = chance.randbytes(chance.randrange(1, 12))
        bench.advance(0.2)
    assert bench.stage.state().position_mm == pytest.approx(200.0, abs=1e-4)
    assert bench.stage.statistics()["skipped_bytes"] > 20


@pytest.mark.fault("bytes lost")
def test_a_move_arrives_in_spite_of_lost_bytes() -> None:
    """driver: requests again what was lost; user reads: broken_frames and skipped_bytes."""
    bench = AptBench(seed=3)
    bench.model.disturbance.loss_share = 0.05
    bench.move(200.0, 50.0)
    assert bench.stage.state().position_mm == pytest.approx(200.0, abs=1e-4)
    statistics = bench.stage.statistics()
    assert statistics["skipped_bytes"] + statistics["broken_frames"] > 0


@pytest.mark.parametrize("rests", [True, False])
@pytest.mark.fault("bit flips")
def test_one_flipped_bit_moves_no_position(bench: AptBench, rests: bool) -> None:
    """driver: uses no single implausible message, requests more; user reads: statuses_rejected."""
    bench.move(100.0)
    if not rests:
        bench.stage.move_to(200.0, 10.0)
    for bit in (*range(16, 48), *range(80, 112)):
        bench.model.disturbance.flips, bench.model.disturbance.flip_bit = 1, bit
        bench.advance(0.12)
        state = bench.stage.state()
        true_mm = bench.model.axis.position_mm(state.t_ns)
        assert state.position_mm == pytest.approx(true_mm, abs=0.02), bit
    assert bench.stage.statistics()["statuses_rejected"] > 10
    assert bench.stage.healthy


@pytest.mark.fault("bit flips")
def test_two_implausible_messages_in_a_row_stop_the_stage(moving: AptBench) -> None:
    """driver: stops; user reads: two status messages in a row are implausible; check cable."""
    moving.model.disturbance.flips = 2
    moving.model.disturbance.flip_bit = 16 + 21

    def next_bit() -> None:
        if moving.model.disturbance.flips == 1:
            moving.model.disturbance.flip_bit = 16 + 19

    moving.on_tick = next_bit
    assert "in a row are implausible" in moving.failure()
    assert at_rest(moving)


@pytest.mark.parametrize("rests", [True, False])
@pytest.mark.fault("encoder jumps")
def test_an_encoder_jump_stops_the_stage(bench: AptBench, rests: bool) -> None:
    """driver: two readings stop it; user reads: the encoder jumped by ... mm; home again."""
    if not rests:
        bench.stage.move_to(200.0, 100.0)
        bench.advance(0.5)
    bench.model.axis.encoder_offset_mm -= 20.0
    text = bench.failure()
    assert "encoder jumped by" in text
    assert "home again" in text
    assert not bench.stage.healthy
    assert at_rest(bench)
    assert bench.sent(STOP)


@pytest.mark.fault("carriage stalls")
def test_a_stalled_carriage_is_stopped_and_disabled(moving: AptBench) -> None:
    """driver: profiled stop, immediate stop, disable; user reads: stuck at ... on its move."""
    moving.model.axis.freeze(moving.clock_ns())
    begun_ns = moving.now_ns
    assert "stuck at" in moving.failure()
    assert moving.now_ns - begun_ns < 400_000_000
    moving.advance(0.6)
    late = [data for at, data in moving.port.written if at > begun_ns]
    assert [data[3] for data in late if data[:2] == b"\x65\x04"] == [2, 1]
    assert not moving.model.enabled


@pytest.mark.fault("carriage stalls")
def test_a_position_error_counts_as_a_stall(moving: AptBench) -> None:
    """driver: the same as for a stall; user reads: the stage is stuck at ..."""
    moving.model.extra_bits = 0x4000
    assert "stuck at" in moving.failure()
    assert at_rest(moving)


@pytest.mark.fault("serial line unplugged, no answer")
def test_an_unplugged_port_fails_at_once(moving: AptBench) -> None:
    """driver: fails at once, as does every later order; user reads: the stage's port failed: ..."""
    moving.model.gone = True
    assert "port failed" in moving.failure()
    with pytest.raises(DeviceGoneError):
        moving.stage.move_to(10.0, 10.0)
    moving.stage.stop()
    moving.stage.close()


@pytest.mark.fault("serial line unplugged, no answer")
def test_a_controller_that_sends_nothing_fails(bench: AptBench) -> None:
    """driver: warns after 0.5 s, fails after 1.5 s; user reads: sent no status for 1.5 s."""
    # The time of a stall of the host alone is no sign of a fault.
    bench.now_ns += 700_000_000
    assert bench.stage.healthy
    bench.advance(0.1)
    bench.model.mute = True
    bench.advance(0.44)
    assert bench.stage.healthy
    bench.advance(0.16)
    assert "status_late" in bench.stage.state().flags
    assert not bench.stage.healthy
    assert "sent no status for 1.5 s" in bench.failure()
    assert 1.4 < bench.stage.statistics()["status_age_s"] < 1.7


@pytest.mark.fault("limit switch")
def test_after_a_limit_in_a_move_only_the_way_back_is_free(bench: AptBench) -> None:
    """driver: stops, allows only the way back; user reads: met a limit at ... mm; move it back."""
    bench.model.axis.obstacle_mm = 80.0
    bench.move(200.0, 100.0)
    state = bench.stage.state()
    assert state.position_mm == pytest.approx(80.0, abs=0.01)
    assert "forward_hard_limit" in state.flags
    with pytest.raises(DeviceError, match=r"met a limit at 80\.000 mm"):
        bench.stage.move_to(150.0, 100.0)
    bench.model.axis.obstacle_mm = None
    bench.move(40.0)
    bench.move(150.0)
    assert bench.stage.state().position_mm == pytest.approx(150.0, abs=1e-4)


@pytest.mark.fault("completion message missing")
def test_motions_end_without_end_messages() -> None:
    """driver: finds the end of homing, move and stop in the status; user reads: nothing."""
    bench = AptBench(home=False)
    bench.model.withheld = {"moved", "stopped", "homed"}
    bench.stage.home()
    bench.until(lambda: bench.stage.state().homed, 20.0)
    bench.move(50.0)
    assert bench.stage.state().position_mm == pytest.approx(50.0, abs=1e-4)
    bench.stage.move_to(200.0, 100.0)
    bench.advance(0.5)
    bench.stage.stop()
    bench.until(lambda: not bench.stage.state().moving)


@pytest.mark.fault("completion message missing")
def test_a_motion_without_end_is_stopped(bench: AptBench) -> None:
    """driver: stops after the longest time it should take; user reads: does not end in time."""
    bench.stage.move_to(30.0, 100.0)
    bench.model.extra_bits = apt_messages.MOVING
    assert "move does not end in time" in bench.failure(10.0)


@pytest.mark.fault("keep-alive missing")
def test_the_keep_alive_is_sent_twice_a_second(bench: AptBench) -> None:
    """driver: sends it from the writer's thread twice a second; user reads: nothing."""
    bench.advance(5.0)
    sent = bench.sent(KEEP_ALIVE)
    assert max(b - a for a, b in itertools.pairwise(sent)) < 700_000_000
    assert bench.stage.healthy


@pytest.mark.fault("keep-alive missing")
def test_the_keep_alive_is_sent_as_often_as_fast_polling_needs_it() -> None:
    """driver: sends it after 20 status messages at the latest; user reads: nothing."""
    bench = AptBench(AptSettings(poll_hz=200.0))
    bench.stage.move_to(200.0, 50.0)
    before = bench.stage.statistics()["frames"]
    bench.advance(2.0)
    assert bench.stage.statistics()["frames"] - before > 380
    assert bench.stage.healthy


@pytest.mark.fault("keep-alive missing")
def test_a_controller_that_a_program_left_without_it_opens(bench: AptBench) -> None:
    """driver: sends it first, which frees the controller's answers; user reads: nothing."""
    bench.link = None
    for _ in range(60):
        bench.model.feed(apt_messages.pack("request_status", apt_messages.SINGLE_UNIT))
        bench.advance(0.01)
        bench.model.step()
    bench.stage = bench.open()
    bench.move(20.0)


@pytest.mark.fault("keep-alive missing")
def test_without_keep_alive_the_link_fails(bench: AptBench) -> None:
    """driver: fails as on a dead link; user reads: sent no status for 1.5 s; check its power ..."""
    write = bench.port.write
    bench.port.write = lambda data: write(b"" if data[:2] == b"\x92\x04" else data)
    assert "sent no status for 1.5 s" in bench.failure(10.0)


@pytest.mark.fault("disabled, not homed, move ignored")
def test_an_axis_that_is_not_enabled_is_refused() -> None:
    """driver: refuses to open; user reads: does not enable the axis; check its front panel."""
    bench = AptBench(home=False)
    bench.model.panel_disabled, bench.model.enabled = True, False
    with pytest.raises(DeviceError, match=r"does not enable the axis; check its front panel"):
        bench.open()


@pytest.mark.fault("disabled, not homed, move ignored")
def test_an_axis_disabled_in_a_move_fails(moving: AptBench) -> None:
    """driver: stops; user reads: does not have the axis enabled any more; configure and home."""
    moving.model.enabled = False
    assert "axis enabled any more" in moving.failure()


@pytest.mark.fault("disabled, not homed, move ignored")
def test_an_ignored_move_fails(bench: AptBench) -> None:
    """driver: sees no motion within 0.3 s; user reads: does not begin its move within 0.3 s."""
    bench.model.ignores_moves = True
    bench.stage.move_to(100.0, 100.0)
    begun_ns = bench.now_ns
    assert "does not begin its move within 0.3 s" in bench.failure()
    assert bench.now_ns - begun_ns < 500_000_000


@pytest.mark.parametrize("text", ["", "Motor over temperature"])
@pytest.mark.fault("controller reports an error")
def test_an_error_message_stops_the_stage(moving: AptBench, text: str) -> None:
    """driver: stops; user reads: the controller's code and text, or to look at its display."""
    moving.model.send_error(17, text)
    read = moving.failure()
    assert (f"error 17: {text}" if text else "look at its display") in read
    assert at_rest(moving)


@pytest.mark.fault("controller reports an error")
def test_reported_faults_stop_the_stage(moving: AptBench) -> None:
    """driver: stops when two messages have them; user reads: reports over_temperature."""
    moving.model.extra_bits = 0x20000
    assert "reports over_temperature" in moving.failure()
    assert at_rest(moving)


@pytest.mark.parametrize("any_error", [0, 0x4000_0000])
@pytest.mark.fault("controller reports an error")
def test_a_refused_command_is_no_fault_of_the_axis(moving: AptBench, any_error: int) -> None:
    """driver: counts it and goes on; user reads: the stage controller refused a command, once."""
    moving.model.extra_bits = 0x8000 | any_error
    moving.until(lambda: not moving.stage.state().moving)
    assert moving.stage.state().position_mm == pytest.approx(200.0, abs=1e-4)
    assert "command_error" in moving.stage.state().flags
    assert moving.stage.statistics()["command_errors"] == 1


def test_a_current_peak_is_no_fault(moving: AptBench) -> None:
    """The controller reports it in fast accelerations; a lasting one disables the axis."""
    moving.model.extra_bits = 0x0400_0000
    moving.until(lambda: not moving.stage.state().moving)
    assert moving.stage.state().position_mm == pytest.approx(200.0, abs=1e-4)
    assert "over_current" in moving.stage.state().flags


@pytest.mark.parametrize("rests", [True, False])
@pytest.mark.fault("controller rebooted")
def test_a_restarted_controller_must_be_homed(bench: AptBench, rests: bool) -> None:
    """driver: stops; user reads: does not have its reference any more; configure and home."""
    bench.move(60.0)
    if not rests:
        bench.stage.move_to(200.0, 100.0)
        bench.advance(0.4)
    bench.model.reboot()
    assert "does not have its reference any more" in bench.failure()
    bench.stage.close()
    bench.stage = bench.open()
    assert not bench.stage.state().homed
    with pytest.raises(DeviceError, match="not homed"):
        bench.stage.move_to(10.0, 10.0)


@pytest.mark.fault("late or double reply")
def test_double_replies_count_once(bench: AptBench) -> None:
    """driver: uses each answer once, by message and source; user reads: nothing."""
    bench.model.disturbance.repeats = 10_000
    bench.move(100.0)
    bench.move(20.0)
    assert bench.stage.state().position_mm == pytest.approx(20.0, abs=1e-4)


@pytest.mark.fault("late or double reply")
def test_a_late_reply_is_requested_again() -> None:
    """driver: requests again and drops the late answer; user reads: nothing."""
    late_ns: list[int] = []
    bench = AptBench(late_ns=lambda: late_ns.pop() if late_ns else 0)
    # Those after it wait for it on the line.
    late_ns.append(350_000_000)
    bench.stage.move_to(100.0, 100.0)
    assert not late_ns
    bench.until(lambda: not bench.stage.state().moving, 20.0)
    assert bench.stage.state().position_mm == pytest.approx(100.0, abs=1e-4)


@pytest.mark.fault("host stalls")
def test_positions_are_exact_after_a_stall_in_a_move(moving: AptBench) -> None:
    """driver: positions stay interpolated, the stall is filled afterwards; user reads: nothing."""
    stall(moving, 0.3)
    before = moving.stage.state()
    assert before.t_ns <= moving.clock_ns() - 300_000_000
    moving.until(lambda: not moving.stage.state().moving, 20.0)
    for t_ns in range(before.t_ns, before.t_ns + 400_000_000, 10_000_000):
        true_mm = moving.model.axis.position_mm(t_ns)
        assert moving.stage.state(t_ns).position_mm == pytest.approx(true_mm, abs=0.02)


@pytest.mark.fault("host stalls")
def test_a_stall_as_a_move_begins_is_no_failure(bench: AptBench) -> None:
    """driver: an answer from before the order does not count for the move; user reads: nothing."""
    for turn, stall_s in itertools.product(range(12), (0.35, 0.8)):
        bench.advance(0.007 * turn)
        target_mm = 20.0 + 60.0 * ((turn + (stall_s > 0.5)) % 2)
        bench.stage.move_to(target_mm, 50.0)
        stall(bench, stall_s)
        bench.until(lambda: not bench.stage.state().moving, 20.0)
        assert bench.stage.state().position_mm == pytest.approx(target_mm, abs=1e-4)


@pytest.mark.fault("host stalls")
@pytest.mark.parametrize("stopped", [False, True])
def test_a_stall_beyond_the_end_of_a_move_is_no_failure(moving: AptBench, stopped: bool) -> None:
    """driver: reads whether the stage rests before it is late; user reads: nothing."""
    if stopped:
        moving.stage.stop()
    stall(moving, 10.0)
    moving.until(lambda: not moving.stage.state().moving, 2.0)
    assert moving.stage.healthy


@pytest.mark.fault("shutdown at any time")
def test_close_while_homing_stops_the_carriage() -> None:
    """driver: stops and closes within 2 s, twice if need be; user reads: nothing."""
    bench = AptBench(AptSettings(homing_mm_s=10.0), home=False, power_up_mm=150.0)
    bench.stage.home()
    bench.advance(1.0)
    begun_ns = bench.now_ns
    bench.stage.close()
    bench.stage.close()
    assert bench.now_ns - begun_ns < 2_000_000_000
    assert not bench.model.axis.moving(bench.clock_ns())
    assert bench.sent(DISCONNECT)
    with pytest.raises(DeviceError, match="closed"):
        bench.stage.move_to(10.0, 10.0)
