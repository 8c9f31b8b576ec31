"""The sensor's clock against ROS time."""

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import ClockLine, SensorClock

EPOCH_NS = 1_760_000_000_000_000_000


def test_announced_zero_stays_and_the_residual_is_the_delay() -> None:
    clock = SensorClock(EPOCH_NS)
    assert clock.residual_ns is None
    clock.observe(1000, EPOCH_NS + 1_000_000 + 250_000)
    assert (clock.zero_ns, clock.residual_ns) == (EPOCH_NS, 250_000)
    clock.observe(2000, EPOCH_NS + 2_000_000 - 10)
    assert (clock.zero_ns, clock.residual_ns) == (EPOCH_NS, -10)


def test_an_unknown_zero_is_an_error() -> None:
    clock = SensorClock()
    assert clock.zero_ns is None
    with pytest.raises(ArgumentError, match="unknown"):
        clock.to_ns(5)


def test_the_window_follows_a_drifting_oscillator_under_late_packets() -> None:
    """-50 ppm over 20 s are 1 ms."""
    rng = np.random.default_rng(6)
    clock = SensorClock(window_ns=5_000_000_000)
    t_us = np.arange(1, 20 * 250) * 4000
    sent = EPOCH_NS + (t_us * (1.0 - 50e-6) * 1000).astype(np.int64)
    arrival = np.maximum.accumulate(sent + rng.exponential(2e6, t_us.size).astype(np.int64))
    errors = []
    for t, arrived, true in zip(t_us.tolist(), arrival.tolist(), sent.tolist(), strict=True):
        clock.observe(t, arrived)
        assert clock.residual_ns >= 0
        errors.append(clock.to_ns(t) - true)
    assert np.abs(errors[1250:]).max() < 60_000
    assert abs(clock.drift_ppm + 50.0) < 6.0
    assert 0 <= clock.offset_age_us < 5_000_000
    assert clock.restarts == 0


def test_window_equals_the_plain_minimum() -> None:
    rng = np.random.default_rng(8)
    clock = SensorClock(window_ns=1_000_000)
    arrival = np.cumsum(rng.integers(0, 200_000, 500))
    t_us = np.sort(rng.integers(0, 10**6, 500))
    for index in range(500):
        clock.observe(int(t_us[index]), int(arrival[index]))
        recent = arrival[: index + 1] >= arrival[index] - 1_000_000
        assert clock.zero_ns == int((arrival[: index + 1] - t_us[: index + 1] * 1000)[recent].min())


def test_time_going_back_restarts_the_window() -> None:
    clock = SensorClock()
    clock.observe(1_000_000, EPOCH_NS)
    clock.observe(100, EPOCH_NS + 1000)
    assert (clock.restarts, clock.to_ns(100)) == (1, EPOCH_NS + 1000)
    clock.observe(200, EPOCH_NS - 10**9)
    assert (clock.restarts, clock.to_ns(200)) == (2, EPOCH_NS - 10**9)


def test_a_line_known_from_edges_is_used_until_the_clock_restarts() -> None:
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
