"""Motion plans: limits kept, target hit, the end at rest for every time after it."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionPlan, plan_move, plan_stop

EPOCH_NS = 1_760_000_000_000_000_000
positions = st.floats(-220.0, 220.0)
moves = st.builds(
    plan_move,
    st.integers(0, EPOCH_NS),
    positions,
    positions,
    st.floats(0.1, 500.0),
    st.floats(1.0, 5000.0),
)


def sample(plan: MotionPlan, count: int = 400) -> np.ndarray:
    span = plan.end_ns - plan.start_ns
    return plan.start_ns + np.linspace(0, 1.1 * span + 10, count).astype(np.int64)


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.integers(0, EPOCH_NS), positions, positions, st.floats(0.1, 500.0), st.floats(1.0, 5e3))
@example(0, 0.0, 37.68659446263427, 500.0, 1.0)
@example(0, 5.0, 5.0, 10.0, 10.0)
@example(0, 0.0, 1e-300, 10.0, 10.0)
def test_moves_hit_the_target_within_their_limits(start_ns, position, target, speed, acceleration):
    plan = plan_move(start_ns, position, target, speed, acceleration)
    t_ns = sample(plan)
    x, v = plan.state(t_ns)
    assert plan.end_mm == pytest.approx(target, abs=1e-9)
    assert x[0] == pytest.approx(position, abs=1e-9)
    assert np.max(np.abs(v)) <= speed * (1 + 1e-12)
    low, high = min(position, target), max(position, target)
    assert x.min() >= low - 1e-9
    assert x.max() <= high + 1e-9
    assert np.all(np.diff(x) * math.copysign(1.0, target - position) >= -1e-9)
    assert all(abs(a) == acceleration or a == 0.0 for a in plan.accelerations_mm_s2)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(moves)
def test_from_the_end_on_the_stage_rests_in_one_place(plan):
    after = plan.end_ns + np.array([0, 1, 2, 10**6, 10**12])
    x, v = plan.state(after)
    assert set(x.tolist()) == {plan.end_mm}
    assert not v.any()
    before = plan.state(plan.start_ns - np.array([1, 10**12]))
    assert set(before[0].tolist()) == {plan.position_mm}
    assert not before[1].any()


@settings(derandomize=True, max_examples=100, deadline=None)
@given(moves)
def test_velocity_is_the_derivative_of_position(plan):
    t_ns = np.arange(plan.start_ns, plan.end_ns + 1, max((plan.end_ns - plan.start_ns) // 500, 1))
    x, v = plan.state(t_ns)
    steepest = max((abs(a) for a in plan.accelerations_mm_s2), default=0.0)
    dt = np.diff(t_ns) * 1e-9
    # The trapezoid rule is exact where the acceleration is constant.
    error = np.abs(np.diff(x) - 0.5 * (v[1:] + v[:-1]) * dt)
    assert np.all(error <= 0.25 * steepest * dt * dt + 1e-6 * dt * np.abs(v).max() + 1e-9)


def test_a_scan_at_300_mm_s():
    plan = plan_move(EPOCH_NS, 10.0, 160.0, 300.0, 3000.0)
    assert plan.durations_s == pytest.approx((0.1, 0.4, 0.1))
    x, v = plan.state(EPOCH_NS + np.array([50, 100, 300, 500, 600]) * 1_000_000)
    np.testing.assert_allclose(x, [13.75, 25.0, 85.0, 145.0, 160.0], atol=1e-9)
    np.testing.assert_allclose(v, [150.0, 300.0, 300.0, 300.0, 0.0], atol=1e-9)


def test_a_short_move_is_a_triangle_and_no_move_is_none():
    plan = plan_move(0, 0.0, -1.0, 300.0, 100.0)
    assert plan.durations_s == pytest.approx((0.1, 0.0, 0.1), abs=1e-15)
    assert float(plan.state(100_000_000)[1]) == pytest.approx(-10.0)
    still = plan_move(7, 3.0, 3.0, 300.0, 100.0)
    assert (still.end_ns, still.end_mm) == (7, 3.0)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(moves, st.floats(-0.1, 1.2), st.floats(10.0, 1e4))
def test_a_stop_is_continuous_and_as_short_as_stated(plan, share, deceleration):
    at_ns = plan.start_ns + round(share * (plan.end_ns - plan.start_ns))
    x, v = (float(value) for value in plan.state(at_ns))
    stop = plan_stop(plan, at_ns, deceleration)
    assert tuple(float(value) for value in stop.state(at_ns)) == pytest.approx(
        (x, v if stop.durations_s and stop.end_ns > at_ns else 0.0)
    )
    assert stop.end_mm == pytest.approx(x + v * abs(v) / (2 * deceleration), abs=1e-9)
    assert stop.end_ns - at_ns == pytest.approx(abs(v) / deceleration * 1e9, abs=1.0)
    _, speeds = stop.state(sample(stop))
    assert np.all(np.diff(np.abs(speeds)) <= 1e-9)
    assert np.all(speeds * v >= 0.0)


def test_state_keeps_shape_and_is_the_same_for_scalars_and_arrays():
    plan = plan_move(EPOCH_NS, 0.0, 100.0, 50.0, 500.0)
    t_ns = (EPOCH_NS + np.arange(12) * 150_000_000).reshape(3, 4)
    x, v = plan.state(t_ns)
    assert x.shape == v.shape == (3, 4)
    for index in np.ndindex(3, 4):
        one_x, one_v = plan.state(int(t_ns[index]))
        assert one_x.shape == ()
        assert (float(one_x), float(one_v)) == (x[index], v[index])


def test_a_plan_without_pieces_rests():
    x, v = MotionPlan(5, 12.5).state([0, 5, 10**18])
    assert (x.tolist(), v.tolist()) == ([12.5] * 3, [0.0] * 3)


def test_impossible_plans_are_refused():
    with pytest.raises(ArgumentError, match="one acceleration per duration"):
        MotionPlan(0, 0.0, 0.0, (1.0,), ())
    with pytest.raises(ArgumentError, match="durations_s"):
        MotionPlan(0, 0.0, 0.0, (-1.0,), (0.0,))
    with pytest.raises(ArgumentError, match="finite"):
        MotionPlan(0, 0.0, 0.0, (1.0,), (math.nan,))
    with pytest.raises(ArgumentError, match="deceleration_mm_s2 is 0"):
        plan_stop(MotionPlan(0, 0.0), 0, 0.0)
