"""Edges that come in one by one, before the odometry that covers them."""

import numpy as np
from stage_pulses import PULSES, StagePulses

from eschorty_ros.core.clocks import EdgeClock, StageTrack

RISING = np.ones(1, np.uint8)


def test_edges_count_once_the_odometry_covers_them():
    bench = StagePulses()
    arrivals = bench.arrivals(3.0)
    clock = EdgeClock(PULSES)
    track = StageTrack(max_gap_us=500_000)
    edges = bench.edges.tolist()
    fits = 0
    for t in range(0, int(bench.true.to_us(bench.until_ns)), 10_000):
        while edges and edges[0] < t:
            clock.add(np.array([edges.pop(0)]), RISING)
        now_us = bench.true.to_ns(t - 30_000) // 1000
        track.append(now_us, bench.position(np.array([now_us * 1000]))[0])
        fits += clock.update(track, arrivals)
        if clock.fit is not None:
            assert min(t, bench.edges[-1]) - 200_000 < clock.until_us <= t
            assert abs(clock.fit.line.to_ns(t) - bench.true.to_ns(t)) * 300e-6 < 30.0
    assert 5 < fits < 20
    clock.update(track, arrivals, now=True)
    assert (clock.until_us, clock.fit.used) == (bench.edges[-1], bench.edges.size)
    assert bench.error_um(clock.fit) < 10.0


def test_no_fit_without_pulses():
    bench = StagePulses()
    clock = EdgeClock(None)
    clock.add(bench.edges, np.ones(bench.edges.size, np.uint8))
    assert not clock.update(bench.track, bench.arrivals(1.0), now=True)
    clock.pulses = PULSES
    assert clock.update(bench.track, bench.arrivals(1.0), now=True)
    assert not clock.update(bench.track, bench.arrivals(1.0), now=True)


def test_the_edges_kept_are_bounded():
    clock = EdgeClock(PULSES)
    for begin in range(0, 100_000, 1000):
        clock.add(np.arange(begin, begin + 1000), np.ones(1000, np.uint8))
    assert (len(clock), clock.edges_dropped) == (8192, 100_000 - 8192)
    clock.add(np.array([200_000_000]), RISING)
    assert (len(clock), clock.edges_dropped) == (1, 100_000 - 8192)
