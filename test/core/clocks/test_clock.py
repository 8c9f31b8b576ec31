"""Stage positions at sensor times and the sensor's clock against ROS time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import ClockLine, SensorClock, StageTrack, quantise_nm

EPOCH_US = 1_760_000_000_000_000
EPOCH_NS = EPOCH_US * 1000


def track(*samples: tuple[int, float], max_gap_us: int | None = None) -> StageTrack:
    stage = StageTrack(max_gap_us)
    for t_us, position_mm in samples:
        stage.append(t_us, position_mm)
    return stage


def test_samples_are_returned_as_the_decimal_they_were() -> None:
    stage = track((5, 123.456789), (10, -0.000001), (11, 220.0))
    assert stage.position_mm([5, 10, 11]).tolist() == [123.456789, -1e-6, 220.0]


def test_samples_that_go_back_are_dropped_and_counted() -> None:
    stage = track((100, 1.0))
    stage.append([90, 100, 200, 150, 200, 300], [9.0, 9.0, 2.0, 9.0, 9.0, 3.0])
    assert stage.dropped == 4
    assert (len(stage), stage.first_us, stage.last_us) == (3, 100, 300)
    np.testing.assert_array_equal(stage.position_mm([100, 150, 250]), [1.0, 1.5, 2.5])


def test_forgetting_keeps_what_later_queries_need() -> None:
    stage = StageTrack()
    for t_us in range(0, 100_000, 10):
        stage.append(t_us, t_us * 1e-3)
        if t_us >= 500:
            stage.forget_before(t_us - 495)
            assert len(stage) <= 52
            assert stage.position_mm([t_us - 495])[0] == pytest.approx((t_us - 495) * 1e-3)
    assert stage.last_us == 99_990
    assert stage.first_us == 99_490
    stage.forget_before(10**9)
    assert (len(stage), stage.first_us) == (1, 99_990)
    empty = StageTrack()
    empty.forget_before(5)
    assert (empty.first_us, empty.last_us) == (None, None)


@settings(derandomize=True, max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-1000, 1000), st.floats(-100, 100)), max_size=600),
    st.integers(1, 600),
)
def test_one_by_one_and_in_blocks_are_the_same(
    samples: list[tuple[int, float]], block: int
) -> None:
    one, blocks = StageTrack(50), StageTrack(50)
    for t_us, position_mm in samples:
        one.append(t_us, position_mm)
    for start in range(0, len(samples), block):
        part = samples[start : start + block]
        blocks.append([s[0] for s in part], [s[1] for s in part])
    query = np.arange(-1001, 1002)
    assert one.position_mm(query).tobytes() == blocks.position_mm(query).tobytes()
    assert (one.dropped, len(one)) == (blocks.dropped, len(blocks))
    assert one.dropped + len(one) == len(samples)


def test_positions_stay_between_their_samples() -> None:
    rng = np.random.default_rng(11)
    t_us = EPOCH_US + np.cumsum(rng.integers(1, 5000, 300))
    position = rng.uniform(0.0, 220.0, 300)
    stage = StageTrack()
    stage.append(t_us, position)
    query = rng.integers(t_us[0], t_us[-1] + 1, 20_000)
    found = stage.position_mm(query)
    np.testing.assert_allclose(
        found, np.interp(query - t_us[0], t_us - t_us[0], position), rtol=0, atol=1.1e-6
    )
    left = np.searchsorted(t_us, query, side="right") - 1
    right = np.minimum(left + 1, 299)
    low, high = (
        np.minimum(position[left], position[right]),
        np.maximum(position[left], position[right]),
    )
    assert ((found >= low - 6e-7) & (found <= high + 6e-7)).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e10])
def test_positions_that_are_none_are_refused(bad: float) -> None:
    with pytest.raises(ArgumentError, match="position_mm is"):
        StageTrack().append(0, bad)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(ArgumentError, match="integers"):
        StageTrack().append(0.5, 1.0)
    with pytest.raises(ArgumentError, match="integers"):
        track((0, 1.0)).position_mm([0.5])
    with pytest.raises(ArgumentError, match="one position for each time"):
        StageTrack().append([1, 2], [1.0])
    with pytest.raises(ArgumentError, match="max_gap_us is 0"):
        StageTrack(0)


def test_quantisation_is_to_the_nanometre() -> None:
    assert quantise_nm([0.0000004, 0.0000006, -1.5, 199.9999999]).tolist() == [
        0, 1, -1_500_000, 200_000_000,
    ]  # fmt: skip


@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.integers(0, 2**60), st.integers(0, 2**52))
def test_conversion_is_exact_both_ways(zero_ns: int, t_us: int) -> None:
    clock = SensorClock(zero_ns)
    assert clock.to_ns(t_us) == zero_ns + 1000 * t_us
    assert clock.to_us(clock.to_ns(t_us)) == t_us
    array = clock.to_ns(np.array([t_us], np.int64))
    assert array.dtype == np.int64
    assert int(array[0]) == clock.to_ns(t_us)
    assert int(clock.to_us(array)[0]) == t_us


def test_nanoseconds_between_microseconds_go_to_the_nearest() -> None:
    clock = SensorClock(EPOCH_NS + 7)
    offsets = np.array([-501, -500, -1, 0, 499, 500, 1499, 1500])
    expected = [-1, 0, 0, 0, 0, 1, 1, 2]
    assert clock.to_us(EPOCH_NS + 7 + offsets).tolist() == expected
    assert [clock.to_us(EPOCH_NS + 7 + int(offset)) for offset in offsets] == expected


def test_announced_zero_stays_and_the_residual_tells_the_delay() -> None:
    clock = SensorClock(EPOCH_NS)
    assert clock.residual_ns is None
    clock.observe(1000, EPOCH_NS + 1_000_000 + 250_000)
    assert (clock.zero_ns, clock.residual_ns) == (EPOCH_NS, 250_000)
    clock.observe(2000, EPOCH_NS + 2_000_000 - 10)
    assert (clock.zero_ns, clock.residual_ns) == (EPOCH_NS, -10)


def test_unknown_zero_is_said() -> None:
    clock = SensorClock()
    assert clock.zero_ns is None
    with pytest.raises(ArgumentError, match="unknown"):
        clock.to_ns(5)


def observe_all(clock: SensorClock, drift: float, seed: int, seconds: int) -> list[int]:
    """Packets every 4 ms, late by an exponential delay; error of the zero after each, ns."""
    rng = np.random.default_rng(seed)
    t_us = np.arange(1, seconds * 250) * 4000
    emitted = EPOCH_NS + (t_us * (1.0 + drift) * 1000).astype(np.int64)
    arrival = np.maximum.accumulate(emitted + rng.exponential(2e6, t_us.size).astype(np.int64))
    errors = []
    for t, arrived, true in zip(t_us.tolist(), arrival.tolist(), emitted.tolist(), strict=True):
        clock.observe(t, arrived)
        assert clock.residual_ns is not None
        assert clock.residual_ns >= 0
        errors.append(clock.to_ns(t) - true)
    return errors


def test_lower_envelope_finds_the_zero_under_late_packets() -> None:
    clock = SensorClock()
    errors = observe_all(clock, 0.0, 5, 20)
    assert min(errors) >= 0
    assert max(errors[250:]) < 50_000
    assert clock.restarts == 0


def test_sliding_window_follows_a_drifting_oscillator() -> None:
    """50 ppm over 60 s is 3 ms, and the line follows it."""
    for drift in (50e-6, -50e-6):
        clock = SensorClock(window_ns=10_000_000_000)
        errors = observe_all(clock, drift, 6, 60)
        assert max(abs(error) for error in errors[2500:]) < 60_000
        assert abs(clock.drift_ppm - drift * 1e6) < 6.0
        assert 0 <= clock.offset_age_us < 10_000_000


def test_window_equals_the_plain_minimum() -> None:
    rng = np.random.default_rng(8)
    clock = SensorClock(window_ns=1_000_000)
    arrival = np.cumsum(rng.integers(0, 200_000, 500))
    t_us = np.sort(rng.integers(0, 10**6, 500))
    for index in range(500):
        clock.observe(int(t_us[index]), int(arrival[index]))
        recent = arrival[: index + 1] >= arrival[index] - 1_000_000
        assert clock.zero_ns == int((arrival[: index + 1] - t_us[: index + 1] * 1000)[recent].min())


def test_time_going_back_starts_the_window_anew() -> None:
    clock = SensorClock()
    clock.observe(1_000_000, EPOCH_NS)
    clock.observe(100, EPOCH_NS + 1000)
    assert clock.restarts == 1
    assert clock.to_ns(100) == EPOCH_NS + 1000
    clock.observe(200, EPOCH_NS - 10**9)
    assert clock.restarts == 2
    assert clock.to_ns(200) == EPOCH_NS - 10**9


def test_a_line_known_from_edges_is_used_until_the_clock_starts_anew() -> None:
    clock = SensorClock()
    clock.observe(1_000_000, EPOCH_NS)
    better = ClockLine(1_000_000, EPOCH_NS - 2_000_000, 50_000)
    clock.adopt(better)
    clock.observe(2_000_000, EPOCH_NS + 1_000_000_000)
    assert clock.from_edges
    assert clock.line == better
    assert clock.residual_ns == 2_000_000 - 50_000
    clock.adopt(None)
    assert clock.line == clock.arrival_line
    clock.adopt(better)
    clock.observe(5, EPOCH_NS + 2_000_000_000)
    assert (clock.restarts, clock.from_edges) == (1, False)
    announced = SensorClock(EPOCH_NS)
    announced.adopt(better)
    assert (announced.zero_ns, announced.exact, announced.drift_ppm) == (EPOCH_NS, True, 0.0)


def test_window_must_be_positive() -> None:
    with pytest.raises(ArgumentError, match="window_ns is 0"):
        SensorClock(window_ns=0)
