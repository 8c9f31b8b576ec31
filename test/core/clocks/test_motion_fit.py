"""Encoder readings to motion: 20 um at 300 mm/s from readings that arrive late."""

from dataclasses import dataclass

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionFit, MotionPlan, plan_move, plan_stop

ORDERED_NS = 1_700_000_000_000_000_000
COUNT_MM = 1 / 20_000
ORDER = plan_move(ORDERED_NS, 5.0, 215.0, 300.0, 2000.0)
LATER = plan_move(ORDERED_NS + 2_000_000, 5.0, 215.0, 300.0, 2000.0)


@dataclass
class Line:
    """A polled encoder: requests go out in time, answers come late by up to ``jitter_ms``."""

    rate_hz: float
    jitter_ms: float
    seed: int
    asked: bool = True
    request_ms: float = 0.0

    def __post_init__(self) -> None:
        self.chance = np.random.default_rng(self.seed)
        self.next_ns = ORDERED_NS - 300_000_000 + int(self.chance.uniform(0, 1e9 / self.rate_hz))

    def read(self, fit: MotionFit, true: MotionPlan, until_ns: int) -> None:
        while self.next_ns < until_ns:
            taken_ns = self.next_ns + int(self.request_ms * 1e6 * self.chance.exponential())
            late_ns = int(self.chance.uniform(0, self.jitter_ms) * 1e6)
            counts = round(float(true.state(taken_ns)[0]) / COUNT_MM)
            fit.add_reading(
                counts * COUNT_MM, taken_ns + late_ns, self.next_ns if self.asked else None
            )
            self.next_ns += int(1e9 / self.rate_hz)


def sweep(line: Line, true: MotionPlan = LATER) -> tuple[MotionFit, MotionPlan]:
    """A sweep over 210 mm, ordered but begun a little later."""
    fit = MotionFit()
    line.read(fit, true, ORDERED_NS)
    fit.expect_move(ORDER)
    line.read(fit, true, true.end_ns + 200_000_000)
    return fit, true


def worst_um(fit: MotionFit, true: MotionPlan) -> float:
    t_ns = np.arange(ORDERED_NS - 100_000_000, true.end_ns + 100_000_000, 500_000)
    return float(np.abs(fit.state(t_ns)[0] - true.state(t_ns)[0]).max() * 1e3)


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 50.0])
@pytest.mark.parametrize("request_ms", [0.0, 0.2])
def test_sweep_at_300_mm_s_within_20_um(rate_hz: float, request_ms: float) -> None:
    lines = [Line(rate_hz, 3.0, seed, request_ms=request_ms) for seed in range(12)]
    errors = [worst_um(*sweep(line)) for line in lines]
    print(f"{rate_hz:g} Hz, requests late by {request_ms} ms: {max(errors):.1f} um at most")
    assert max(errors) < 20.0


@pytest.mark.parametrize("speed_mm_s", [0.05, 0.5, 5.0])
def test_a_slow_move_is_known_as_it_goes(speed_mm_s: float) -> None:
    """Readings of 1 um leave its start uncertain for long, but not its position."""
    order = plan_move(ORDERED_NS, 10.0, 10.0 + 5.0 * speed_mm_s, speed_mm_s, 2000.0)
    true = plan_move(ORDERED_NS + 1_500_000, 10.0, 10.0 + 5.0 * speed_mm_s, speed_mm_s, 2000.0)
    fit, line = MotionFit(), Line(20.0, 3.0, seed=1)
    line.read(fit, true, ORDERED_NS)
    fit.expect_move(order)
    for until_ns in range(ORDERED_NS + 500_000_000, true.end_ns, 100_000_000):
        line.read(fit, true, until_ns)
        assert fit.until_ns is not None
        assert until_ns - fit.until_ns < 100_000_000
    assert worst_um(fit, true) < 1.0


def test_receipt_alone_within_the_lower_envelope() -> None:
    errors = [worst_um(*sweep(Line(50.0, 0.5, seed, asked=False))) for seed in range(12)]
    print(f"receipt only, 0.5 ms of jitter: {max(errors):.1f} um at most")
    assert max(errors) < 20.0


def test_odometry_of_the_past_is_as_good_once_the_delays_are_known() -> None:
    errors = []
    for seed in range(6):
        line = Line(50.0, 2.0, seed, request_ms=0.1)
        fit, true = sweep(line)
        begin_ns = true.end_ns + 500_000_000
        back = plan_move(begin_ns + 1_500_000, 215.0, 5.0, 300.0, 2000.0)
        line.read(fit, back, begin_ns)
        fit.expect_move(plan_move(begin_ns, 215.0, 5.0, 300.0, 2000.0))
        for now_ns in range(begin_ns, back.end_ns + 200_000_000, 10_000_000):
            line.read(fit, back, now_ns)
            t_ns = now_ns - 100_000_000
            errors.append(abs(float(fit.state(t_ns)[0] - back.state(t_ns)[0])) * 1e3)
    print(f"100 ms in the past: {max(errors):.1f} um at most")
    assert max(errors) < 20.0


def test_other_acceleration_and_speed_are_found() -> None:
    true = plan_move(ORDERED_NS + 1_000_000, 5.0, 215.0, 298.0, 1850.0)
    fit, _ = sweep(Line(50.0, 1.0, 3), true)
    assert worst_um(fit, true) < 100.0
    assert fit.residual_mm < 0.02
    # An overshoot, which the model of the motion never reaches.
    past_ns = true.end_ns + 210_000_000
    fit.add_reading(true.end_mm + 0.003, past_ns + 500_000, past_ns - 500_000)
    assert worst_um(fit, true) < 100.0


def test_wrong_readings_are_outliers_and_leave_no_error() -> None:
    true, fit = ORDER, MotionFit()
    fit.expect_move(true)
    line = Line(50.0, 1.0, 4)
    for k, until_ns in enumerate(range(ORDERED_NS, true.end_ns, 100_000_000)):
        line.read(fit, true, until_ns)
        if k in (3, 5):
            at_ns = line.next_ns - 10_000_000
            fit.add_reading(float(true.state(at_ns)[0]) + 0.4, at_ns + 500_000, at_ns - 500_000)
    line.read(fit, true, true.end_ns + 100_000_000)
    assert fit.outliers == 2
    assert worst_um(fit, true) < 20.0


def test_a_motion_that_is_not_the_ordered_one_is_discarded() -> None:
    blocked = plan_stop(ORDER, ORDERED_NS + 300_000_000, 20_000.0)
    fit = MotionFit()
    fit.expect_move(ORDER)
    line = Line(50.0, 1.0, 5)
    line.read(fit, ORDER, ORDERED_NS + 300_000_000)
    line.read(fit, blocked, ORDERED_NS + 3_000_000_000)
    late_ns = ORDERED_NS + 2_500_000_000
    assert float(fit.state(late_ns)[0]) == pytest.approx(blocked.end_mm, abs=1e-3)


def test_profiled_stop_is_placed_by_where_it_ends() -> None:
    moving = plan_move(ORDERED_NS + 1_000_000, 5.0, 215.0, 300.0, 2000.0)
    stopped = plan_stop(moving, ORDERED_NS + 352_000_000, 2000.0)
    fit = MotionFit()
    line = Line(50.0, 1.0, 6)
    line.read(fit, moving, ORDERED_NS)
    fit.expect_move(ORDER)
    line.read(fit, moving, ORDERED_NS + 350_000_000)
    fit.expect_stop(ORDERED_NS + 350_000_000, 2000.0)
    line.read(fit, stopped, stopped.end_ns + 200_000_000)
    t_ns = np.arange(stopped.start_ns, stopped.end_ns + 100_000_000, 1_000_000)
    assert np.abs(fit.state(t_ns)[0] - stopped.state(t_ns)[0]).max() < 0.02


def test_unknown_motion_is_interpolated_and_late_readings_counted() -> None:
    fit = MotionFit()
    fit.add_reading(1.0, 1000)
    fit.add_reading(3.0, 2000)
    fit.add_reading(9.0, 1500)
    position, velocity = fit.state([500, 1000, 1500, 2000, 9000])
    assert position.tolist() == [1.0, 1.0, 2.0, 3.0, 3.0]
    assert velocity.tolist() == pytest.approx([0.0, 2e6, 2e6, 2e6, 0.0])
    assert fit.late_readings == 1
    assert fit.until_ns == 2000


def test_wrong_arguments_are_refused() -> None:
    fit = MotionFit()
    with pytest.raises(ArgumentError, match="position is unknown"):
        fit.state(0)
    with pytest.raises(ArgumentError, match="after latest_ns"):
        fit.add_reading(0.0, 5, 6)
    with pytest.raises(ArgumentError, match="tolerance_mm"):
        MotionFit(-1.0)
