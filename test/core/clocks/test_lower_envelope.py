"""Offset and drift from arrivals that are late by any time, but never early."""

import numpy as np
import pytest

from eschorty_ros.core.clocks import LowerEnvelope
from eschorty_ros.core.clocks.lower_envelope import _lower_hull

SEED = 12
EPOCH_NS = 1_760_000_000_123_456_789


def packets(seconds, drift, delay_ns, *, period_us=4000, start_us=77, seed=SEED):
    """Sensor times, true ROS times and arrivals; ``delay_ns(t_s, rng)`` is each packet's delay."""
    rng = np.random.default_rng(seed)
    since = np.arange(round(seconds * 1e6 / period_us)) * period_us
    true_ns = EPOCH_NS + since * 1000 + np.rint(since * drift * 1e3).astype(np.int64)
    delay = np.asarray(delay_ns(since * 1e-6, rng)).astype(np.int64)
    return since + start_us, true_ns, np.maximum.accumulate(true_ns + delay)


def jitter(t_s, rng):
    return rng.uniform(0.0, 3e6, t_s.size)


def errors(stream, settled_s=0.0, window_s=60):
    """Error of the line at each packet, ns, once ``settled_s`` have passed; and the envelope."""
    envelope, found = LowerEnvelope(window_s * 1_000_000_000), []
    for t, true, arrived in zip(*(part.tolist() for part in stream), strict=True):
        envelope.observe(t, arrived)
        assert envelope.line.to_ns(t) <= arrived
        if t >= settled_s * 1e6:
            found.append(envelope.line.to_ns(t) - true)
    return np.array(found), envelope


@pytest.mark.parametrize("drift_ppm", [0.0, 50.0, -50.0, 150.0])
def test_offset_and_drift_under_three_milliseconds_of_jitter(drift_ppm):
    off, envelope = errors(packets(30.0, drift_ppm * 1e-6, jitter), settled_s=1.0)
    print(f"seed {SEED}: {off.min():.0f} to {off.max():.0f} ns")
    assert np.abs(off).max() < 300_000
    assert np.abs(off[-2500:]).max() < 60_000
    assert abs(envelope.line.drift_ppb * 1e-3 - drift_ppm) < 3.0


def test_without_delay_the_line_is_the_truth():
    stream = packets(20.0, 37e-6, lambda t_s, rng: np.zeros(t_s.size))
    off, envelope = errors(stream, settled_s=5.0)
    assert np.abs(off).max() < 50
    assert abs(envelope.line.drift_ppb - 37_000) <= 1


def lagging(t_s, rng):
    """Prompt for 5 s, then behind by up to 4 s for as long as it takes to catch up."""
    busy = np.clip(t_s - 5.0, 0.0, None) * 0.4
    return jitter(t_s, rng) + 1e9 * np.where(t_s < 15.0, busy, np.clip(19.0 - t_s, 0.0, 4.0))


@pytest.mark.parametrize("drift_ppm", [0.0, 50.0, -50.0])
def test_seconds_of_lag_neither_shift_nor_tilt_the_line(drift_ppm):
    """A slow machine hands the camera's bytes on seconds late, in the middle of a sweep."""
    off, _ = errors(packets(25.0, drift_ppm * 1e-6, lagging), settled_s=2.0)
    print(f"seed {SEED}: {off.min():.0f} to {off.max():.0f} ns")
    # Ten seconds are extrapolated from five.
    assert np.abs(off).max() < 400_000


def test_a_host_that_is_slow_at_first_leaves_no_error_once_it_is_prompt():
    def slow_at_first(t_s, rng):
        return jitter(t_s, rng) + 3e9 * np.exp(-((t_s / 2.0) ** 2))

    off, _ = errors(packets(12.0, 50e-6, slow_at_first), settled_s=10.0)
    assert np.abs(off).max() < 300_000


def test_ever_growing_lag_is_not_taken_for_drift():
    off, _ = errors(packets(20.0, 0.0, lambda t_s, rng: 1e8 * t_s))
    assert np.abs(off).max() <= 4_000_000


def test_the_window_slides():
    """The oscillator changes its drift in the middle."""
    t, true, arrival = packets(25.0, 0.0, jitter)
    bent = np.clip(t - 8_000_000, 0, None) // 10
    off, envelope = errors((t, true + bent, arrival + bent), window_s=10)
    assert np.abs(off[-1000:]).max() < 60_000
    assert abs(envelope.line.drift_ppb - 100_000) < 8000
    assert len(envelope) <= 601


@pytest.mark.parametrize("start_us", [0, 2**24 - 5_000_000, 2**31 - 5_000_000, 1_700_000 * 10**9])
def test_the_result_does_not_depend_on_the_uptime(start_us):
    lines = []
    for begin in (0, start_us):
        envelope = LowerEnvelope(60_000_000_000)
        # A multiple of the bins' length, so that the same packets share one.
        begin -= begin % 100_000
        t, _, arrival = packets(10.0, 50e-6, jitter, start_us=begin)
        for now, arrived in zip(t.tolist(), arrival.tolist(), strict=True):
            envelope.observe(now, arrived)
        line = envelope.line
        lines.append((line.origin_us - begin, line.origin_ns, line.drift_ppb))
    assert lines[0] == lines[1]


def test_line_touches_and_never_lies_above_the_points():
    rng = np.random.default_rng(SEED)
    for _ in range(50):
        envelope = LowerEnvelope(60_000_000_000)
        t = np.cumsum(rng.integers(0, 200_000, 200))
        arrival = np.cumsum(rng.integers(0, 300_000_000, 200))
        for now, arrived in zip(t.tolist(), arrival.tolist(), strict=True):
            envelope.observe(now, arrived)
            assert envelope.line.to_ns(now) <= arrived
        assert envelope.touched_us in t


def test_hull_against_all_pairs():
    rng = np.random.default_rng(SEED)
    for _ in range(100):
        x = np.sort(rng.integers(0, 30, 20)).astype(float)
        y = rng.integers(0, 30, 20).astype(float)
        corners = _lower_hull(x, y)
        assert (np.diff(x[corners]) > 0).all()
        at = np.interp(x, x[corners], y[corners])
        assert (at <= y + 1e-12).all()
        assert (np.diff(np.diff(y[corners]) / np.diff(x[corners])) > 0).all()
