"""An unknown phase is found, and tracked while the generator's clock drifts."""

from dataclasses import replace

import numpy as np
import pytest
from reconstructing import CALIBRATION, reconstruct

from eschorty_ros.core.evt3 import Encoder, sort_readout
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.held_events import HeldEvents
from eschorty_ros.core.modulation.phase_estimate import estimation_window
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.core.reconstruction.profile_length import ProfileLength

SEED = 5
SINGLE = Settings(events_min=1, isolation_events=0, smoothing_half_width=0, periods_per_profile=1)
EDGE_US = 1000
COLUMNS = 16
NARROW = replace(CALIBRATION, columns=COLUMNS)


def bursts(frequency_hz, seconds, ppm=0.0, *, per_period=32, edge_us=EDGE_US, duty=0.5, seed=SEED):
    """Events of all columns: half after each edge of a generator whose period is ``ppm`` longer."""
    rng = np.random.default_rng(seed)
    period_us = 1e6 / frequency_hz * (1 + ppm * 1e-6)
    k = np.arange(int(seconds * 1e6 / period_us))
    t, p = [], []
    for polarity, share in ((1, 0.0), (0, duty)):
        start = np.repeat(edge_us + (k + share) * period_us, per_period // 2)
        t.append(start + rng.gamma(2.0, min(60.0, period_us / 8) / 2, start.size))
        p.append(np.full(start.size, polarity))
    noise = k.size * per_period // 20
    t.append(edge_us + rng.random(noise) * k.size * period_us)
    p.append(rng.integers(0, 2, noise))
    t = np.rint(np.concatenate(t)).astype(np.int64)
    y = np.clip(np.rint(rng.normal(300.0, 8.0, t.size)), 0, 719)
    x = rng.integers(0, COLUMNS, t.size)
    return sort_readout(
        t, x.astype(np.uint16), y.astype(np.uint16), np.concatenate(p).astype(np.uint8)
    )


def noise(begin_us, end_us, count, seed=SEED):
    rng = np.random.default_rng(seed)
    return sort_readout(
        rng.integers(begin_us, end_us, count),
        rng.integers(0, COLUMNS, count).astype(np.uint16),
        rng.integers(0, 720, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
    )


def joined(*parts):
    return tuple(np.concatenate(fields) for fields in zip(*parts, strict=True))


def edges_of(data, modulation, cuts=()):
    found, reconstructor = reconstruct(data, modulation, SINGLE, cuts, NARROW)
    return np.unique(found.edge_us), reconstructor.counters


def off(edges_us, frequency_hz, ppm, edge_us=EDGE_US):
    """Distance from the generator's edges as a share of the period."""
    turns = (edges_us - edge_us) / (1e6 / frequency_hz * (1 + ppm * 1e-6))
    return turns - np.rint(turns)


@pytest.mark.parametrize(
    ("frequency_hz", "seconds", "ppm", "limit"),
    [(1000.0, 40.0, 100.0, 0.015), (1000.0, 20.0, -100.0, 0.015), (300.0, 20.0, 100.0, 0.015),
     (70.0, 30.0, 100.0, 0.015), (20_000.0, 2.0, 100.0, 0.09)],
)  # fmt: skip
def test_the_edges_follow_a_generator_with_a_clock_of_its_own(frequency_hz, seconds, ppm, limit):
    """Untracked, 100 ppm over 40 s at 1 kHz are four whole periods."""
    per_period = 32 if frequency_hz > 500 else 200
    data = Encoder().encode(*bursts(frequency_hz, seconds, ppm, per_period=per_period))
    edges_us, counts = edges_of(data, Modulation(frequency_hz))
    worst = np.abs(off(edges_us, frequency_hz, ppm)).max()
    assert worst < limit, f"seed {SEED}"
    assert counts["phase_relocks"] == 0
    assert counts["phase_corrections"] > 10


@pytest.mark.parametrize("size", [1 << 20, 50_000, 977, 64])
def test_the_edges_do_not_depend_on_how_the_stream_is_cut(size):
    dark = noise(2_300_000, 9_000_000, 300)
    later = bursts(1000.0, 1.0, 80.0, edge_us=9_000_411)
    data = Encoder().encode(*joined(bursts(1000.0, 2.0, 80.0), dark, later))
    whole, counts = edges_of(data, Modulation(1000.0))
    cut, cut_counts = edges_of(data, Modulation(1000.0), range(size, len(data), size))
    np.testing.assert_array_equal(cut, whole)
    assert cut_counts == counts
    assert counts["phase_relocks"] == 1


@pytest.mark.parametrize("pause_us", [2_000, 400_000, 20_000_000])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_laser_switched_off_and_on_again_has_its_new_phase(pause_us, share):
    restart_us = EDGE_US + 1_000_000 + pause_us + round(share * 1000)
    dark = noise(EDGE_US + 1_000_000, restart_us, pause_us // 2000)
    data = Encoder().encode(
        *joined(bursts(1000.0, 1.0), dark, bursts(1000.0, 1.0, edge_us=restart_us))
    )
    edges, counts = edges_of(data, Modulation(1000.0))
    settled = edges[edges > restart_us + 80_000]
    assert settled.size > 900
    assert np.abs(off(settled, 1000.0, 0.0, restart_us)).max() < 0.02
    assert counts["phase_relocks"] == 1
    assert (np.diff(edges) > 400).all()


@pytest.mark.parametrize("duty", [0.2, 0.8])
def test_background_of_a_part_of_a_period_is_no_phase(duty):
    """In half a dark period there is more of it than is needed for an estimate."""
    periods = 160
    end_us = EDGE_US + int(periods * 1e6 / 70.0)
    line = bursts(70.0, (periods + 1) / 70.0, per_period=3000, duty=duty)
    data = Encoder().encode(*sort_readout(*joined(line, noise(EDGE_US, end_us, 9000 * periods))))
    edges_us, counts = edges_of(data, Modulation(70.0, duty=duty))
    assert np.abs(off(edges_us, 70.0, 0.0)).max() < 0.02, f"seed {SEED}"
    assert edges_us.size >= periods
    assert counts["phase_relocks"] == 0


def test_a_known_phase_is_not_corrected():
    data = Encoder().encode(*bursts(1000.0, 2.0, 100.0))
    edges, counts = edges_of(data, Modulation(1000.0, on_edge_us=EDGE_US))
    assert ((edges - EDGE_US) % 1000 == 0).all()
    assert counts["phase_corrections"] == 0


def test_noise_moves_nothing():
    data = Encoder().encode(*joined(bursts(1000.0, 0.5), noise(510_000, 3_000_000, 60_000)))
    edges, counts = edges_of(data, Modulation(1000.0))
    assert np.abs(off(edges, 1000.0, 0.0)).max() < 0.02
    assert counts["phase_relocks"] == 0


def test_windows_that_showed_no_laser_are_searched_once():
    """A minute in the dark must not delay the first light."""
    modulation, held = Modulation(200.0), HeldEvents()
    dark = noise(0, 4_000_000, 100_000)
    held.append(dark)
    assert ProfileLength(modulation).choose(held, 4_000_000) == 0
    rest = dark[0][held.searched :]
    assert held.searched > 0
    assert estimation_window(rest, 4_000_000, modulation) is None
