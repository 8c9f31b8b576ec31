"""Edges are exact for any time, follow triggers, and are found in the events."""

from fractions import Fraction

import numpy as np
import pytest
from line_events import line_events

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.edges import EdgeSchedule
from eschorty_ros.core.modulation.phase_estimate import estimate_phase, estimation_window

SEED = 31


def collect(schedule: EdgeSchedule, until_us: int, pieces: int = 1, start_us: int = 0):
    edges, indices = [], []
    for watermark in np.linspace(start_us, until_us, pieces + 1)[1:].astype(np.int64):
        while True:
            e, k = schedule.advance(int(watermark))
            edges.extend(e.tolist())
            indices.extend(k.tolist())
            if len(e) < 1 << 14:
                break
    return np.array(edges), np.array(indices)


@pytest.mark.parametrize("frequency", [16.0, 69.99731, 70.0, 1000.0, 19_999.7])
@pytest.mark.parametrize("epoch", [0, 1_700_000_000_000_000])
def test_edges_are_the_exact_quotient(frequency, epoch):
    modulation = Modulation(frequency, on_edge_us=17)
    schedule = EdgeSchedule(modulation)
    schedule.anchor(17, epoch + 5)
    edges, indices = collect(schedule, epoch + 300_000)
    period = 1_000_000 / Fraction(frequency)
    assert -0.75 * period <= epoch + 5 - edges[0] <= 0.25 * period
    assert (np.diff(indices) == 1).all()
    assert edges.tolist() == [17 + round(int(k) * period) for k in indices]
    assert edges.tolist() == [modulation.edge_us(int(k)) for k in indices]


def test_every_third_edge():
    schedule = EdgeSchedule(Modulation(1000.0), every=3)
    schedule.anchor(0, 9_700)
    edges, indices = collect(schedule, 20_000)
    assert edges.tolist() == [9000, 12_000, 15_000, 18_000]
    assert indices.tolist() == [9, 12, 15, 18]


def test_a_profile_that_began_long_before_the_stream_is_left_out():
    schedule = EdgeSchedule(Modulation(1000.0), every=3)
    schedule.anchor(0, 9_800)
    assert collect(schedule, 20_000)[0].tolist() == [12_000, 15_000, 18_000]


def test_triggers_replace_predictions_and_missing_ones_are_bridged():
    rng = np.random.default_rng(SEED)
    true_us = 500 + np.arange(60) * 1000 + np.cumsum(rng.integers(-3, 4, 60))
    missing = [10, 11, 30]
    schedule = EdgeSchedule(Modulation(1000.0))
    schedule.add_triggers(np.delete(true_us, missing))
    schedule.anchor(int(true_us[0]), int(true_us[0]), triggered=True)
    edges, indices = collect(schedule, int(true_us[-1]) + 100, pieces=7)
    assert len(edges) == 60
    assert (np.diff(indices) == 1).all()
    np.testing.assert_array_equal(np.delete(edges, missing), np.delete(true_us, missing))
    assert np.abs(edges - true_us).max() < 10
    assert schedule.counters["edges_bridged"] == 3
    assert schedule.counters["triggers_spurious"] == 0


def test_spurious_trigger_is_ignored_and_a_new_phase_is_taken_after_three_misses():
    schedule = EdgeSchedule(Modulation(1000.0))
    before, after = np.arange(0, 10_000, 1000), np.arange(12_400, 30_000, 1000)
    schedule.add_triggers(np.sort(np.concatenate([before, [3500], after])))
    schedule.anchor(0, 0)
    edges, _ = collect(schedule, 30_000)
    assert 3500 not in edges
    assert np.isin(after[4:], edges).all()
    assert schedule.counters["triggers_spurious"] >= 1
    assert (np.diff(edges) > 0).all()


def test_triggers_that_come_now_and_then_set_no_phase():
    """As a motor's noise on an open input: none comes one or two periods after another."""
    rng = np.random.default_rng(SEED)
    print(f"seed {SEED}")
    noise_us = np.cumsum(rng.integers(3000, 20_000, 30))
    schedule = EdgeSchedule(Modulation(1000.0))
    schedule.add_triggers(noise_us)
    assert schedule.first_pair_us(10**6) is None
    schedule.anchor(0, 0)
    edges, _ = collect(schedule, int(noise_us[-1]) + 1000, pieces=9)
    assert (edges % 1000 == 0).all()
    assert schedule.counters["triggers_spurious"] == noise_us.size


@pytest.mark.parametrize("late_us", [-40, 40])
def test_first_trigger_near_a_prediction_adds_no_period(late_us):
    schedule = EdgeSchedule(Modulation(1000.0))
    schedule.anchor(0, 0)
    first, _ = collect(schedule, 2500)
    schedule.add_triggers(np.arange(3000 + late_us, 8000, 1000))
    rest, _ = collect(schedule, 8000)
    edges = np.concatenate([first, rest])
    assert len(edges) == 8 if late_us > 0 else len(edges) in (8, 9)
    assert (np.diff(edges) > 900).all()


@pytest.mark.parametrize("frequency", [70.0, 300.0, 1000.0])
@pytest.mark.parametrize("background", [0.05, 0.5])
def test_phase_from_events(frequency, background):
    rng = np.random.default_rng(SEED)
    period = 1e6 / frequency
    t, _, _, p = line_events(
        rng, lambda k, c: np.full(c.shape, 300.0), frequency_hz=frequency, periods=6, columns=200,
        background=background, edge_us=123_456,
    )  # fmt: skip
    late = t >= 123_456 + 0.4 * period
    found = estimate_phase(t[late], p[late], Modulation(frequency))
    error = (found.edge_us - 123_456 + period / 2) % period - period / 2
    assert found.found
    assert abs(error) < 0.05 * period, f"seed {SEED}: {error:.0f} us"


def test_noise_has_no_phase():
    rng = np.random.default_rng(SEED)
    for _ in range(20):
        t = np.sort(rng.integers(0, 60_000, 3000))
        assert not estimate_phase(t, rng.integers(0, 2, 3000), Modulation(70.0)).found


@pytest.mark.parametrize("row_us", [1, 2, 3])
def test_a_burst_that_is_read_out_row_by_row_begins_with_its_first_row(row_us):
    """At 5 kHz a row takes a good part of a bin of the estimate: bins between rows are empty."""
    t = 1000 + 200 * np.arange(30)[:, None] + np.arange(0, 60, row_us)
    t, p = np.repeat(np.concatenate([t, t + 100]).ravel(), 16), np.repeat([1, 0], t.size * 16)
    order = np.argsort(t, kind="stable")
    found = estimate_phase(t[order], p[order].astype(np.uint8), Modulation(5000.0))
    assert found.found
    assert abs((found.edge_us - 1000 + 100) % 200 - 100) <= 2


@pytest.mark.parametrize("edge_us", range(20_000, 20_072, 8))
def test_a_burst_of_a_microsecond_begins_with_its_events_and_not_with_the_background(edge_us):
    """All its events are in one bin of the estimate."""
    rng = np.random.default_rng(SEED)
    burst = np.repeat(edge_us + np.rint(np.arange(6) * 1e6 / 70.0), 2000)
    t = np.sort(np.concatenate([burst, rng.uniform(0, 100_000, 500)])).astype(np.int64)
    found = estimate_phase(t, np.ones(t.size, np.uint8), Modulation(70.0))
    error = (found.edge_us - edge_us + 7143) % 14286 - 7143
    assert abs(error) < 100, f"seed {SEED}: {error:.0f} us"


def test_window_does_not_depend_on_when_it_is_asked_for():
    rng = np.random.default_rng(SEED)
    t = np.sort(rng.integers(0, 10_000_000, 20_000))
    modulation = Modulation(70.0)
    answers = {
        estimation_window(t[: int(np.searchsorted(t, w))], w, modulation)
        for w in range(0, 10_000_000, 100_000)
    }
    answers.discard(None)
    assert len(answers) == 1
