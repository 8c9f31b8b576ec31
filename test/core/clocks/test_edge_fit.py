"""Pulses at known positions give offset and drift of the sensor's clock."""

import numpy as np
import pytest
from stage_pulses import EPOCH_NS, PULSES, SEED, StagePulses

from eschorty_ros.core.clocks import PulseTrain, StageTrack, fit_edges, leading_edges


@pytest.mark.parametrize("late_ms", [-2.0, 0.3, 4.0, 9.0, 25.0])
def test_one_sweep_gives_the_clock_to_a_few_micrometres(late_ms):
    bench = StagePulses()
    fit = fit_edges(bench.edges, bench.track, PULSES, bench.arrivals(late_ms, 45.0))
    print(f"seed {SEED}: {bench.error_um(fit):.1f} um, {fit}")
    assert bench.error_um(fit) < 10.0
    assert fit.used + fit.missing >= 99
    assert fit.residual_mm < 0.015


def test_several_sweeps_give_the_drift():
    bench = StagePulses((10.0, 210.0, 10.0, 210.0, 10.0))
    fit = fit_edges(bench.edges, bench.track, PULSES, bench.arrivals(3.0, 0.0))
    assert bench.error_um(fit) < 10.0
    assert fit.line.drift_ppb * 1e-3 == pytest.approx(50.0, abs=3.0)


@pytest.mark.parametrize("seed", range(10))
def test_missing_and_spurious_edges_and_noisy_odometry(seed):
    bench = StagePulses(missing=0.03, spurious=8, odometry_mm=0.02, seed=seed)
    fit = fit_edges(bench.edges, bench.track, PULSES, bench.arrivals(2.0))
    print(f"seed {seed}: {bench.error_um(fit):.1f} um, {fit}, {bench.missing} missing")
    assert bench.error_um(fit) < 20.0
    assert fit.spurious == pytest.approx(8, abs=3)
    assert fit.missing == pytest.approx(bench.missing, abs=2)


@pytest.mark.parametrize(
    ("travel_mm", "late_ms"),
    [((10.0, 210.0), 40.0), ((10.0, 210.0), 800.0), ((10.0, 210.0), 4000.0), ((210.0, 10.0), 3.0)],
)
def test_the_ramps_correct_a_host_that_was_slow_from_the_start(travel_mm, late_ms):
    bench = StagePulses(travel_mm)
    fit = fit_edges(bench.edges, bench.track, PULSES, bench.arrivals(late_ms))
    assert bench.error_um(fit) < 10.0


@pytest.mark.parametrize(("interval", "speed"), [(0.5, 300.0), (2.0, 20.0), (10.0, 100.0)])
def test_other_intervals_and_speeds(interval, speed):
    pulses = PulseTrain(0.0, interval, round(220 / interval))
    bench = StagePulses(speed=speed, pulses=pulses)
    fit = fit_edges(bench.edges, bench.track, pulses, bench.arrivals(1.5))
    # Positions are wrong by the error in time times the speed there is.
    assert bench.error_um(fit) * speed / 300.0 < 10.0


def test_a_slow_sweep_after_a_fast_way_to_its_start():
    """The edges of the sweep count, too, however fast others were."""
    fast = StagePulses((200.0, 10.0))
    slow = StagePulses((10.0, 40.0), 50.0, lead_s=fast.until_ns * 1e-9 - EPOCH_NS * 1e-9 + 20.0)
    track = StageTrack()
    for part in (fast, slow):
        t_ns = np.arange(part.plans[0].start_ns - 10**8, part.until_ns, 10**7)
        track.append(t_ns // 1000, part.position(t_ns))
    edges = np.concatenate([fast.edges, slow.edges])
    fit = fit_edges(edges, track, PULSES, slow.arrivals(3.0, 0.0))
    assert fit.used >= edges.size - 1
    assert slow.error_um(fit) * 50.0 / 300.0 < 5.0


def test_edges_of_a_laser_are_refused():
    bench = StagePulses()
    laser = np.arange(int(bench.edges[0]) - 10**6, int(bench.edges[-1]) + 10**6, 14_286)
    assert fit_edges(laser, bench.track, PULSES, bench.arrivals(3.0)) is None


def test_too_few_edges_or_none_within_the_odometry_give_no_fit():
    bench = StagePulses()
    assert fit_edges(bench.edges[:7], bench.track, PULSES, bench.arrivals(1.0)) is None
    assert fit_edges(bench.edges + 10**9, bench.track, PULSES, bench.arrivals(1.0)) is None
    assert fit_edges(bench.edges, StageTrack(), PULSES, bench.arrivals(1.0)) is None


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("width_us", [10, 500, 5000])
def test_pulses_begin_with_the_edge_after_which_the_width_is_steady(flipped, width_us):
    bench = StagePulses(width_us=width_us)
    t = np.concatenate([bench.edges, bench.falls])
    rising = np.repeat([1, 0], bench.edges.size).astype(np.uint8)
    order = np.argsort(t, kind="stable")
    found = leading_edges(t[order], (rising ^ flipped)[order])
    np.testing.assert_array_equal(found, bench.edges)
    for kind in (0, 1):
        only = leading_edges(bench.edges, np.full(bench.edges.size, kind, np.uint8))
        np.testing.assert_array_equal(only, bench.edges)
