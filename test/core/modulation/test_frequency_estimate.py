"""The frequency that events show, against the one that is expected."""

import numpy as np
import pytest

from eschorty_ros.core.modulation.frequency_estimate import FrequencyEstimate


def bursts(frequency_hz, seconds, per_burst=200, width=0.1, seed=5):
    """Times of ON events after each rising edge, spread over `width` of a period."""
    rng = np.random.default_rng(seed)
    edges = np.arange(0.0, seconds, 1.0 / frequency_hz)
    late = rng.uniform(0.0, width / frequency_hz, (edges.size, per_burst))
    return ((edges[:, None] + late) * 1e6).ravel().astype(np.int64)


def shown_hz(expected_hz, *times):
    t_us = np.sort(np.concatenate(times))
    estimate = FrequencyEstimate()
    for part in np.array_split(t_us, 7):
        estimate.add(part, np.ones(part.size, np.uint8))
    return estimate.frequency_hz(expected_hz)


NOISE = np.random.default_rng(6).integers(0, 3_000_000, 30_000)


@pytest.mark.parametrize("true_hz", [20.0, 70.0, 1003.7, 15_000.0])
@pytest.mark.parametrize("factor", [0.5, 1.0, 1.0005, 71 / 70, 10 / 7, 2.0, 3.0, 10.0])
def test_events_show_their_frequency(true_hz, factor):
    expected_hz = factor * true_hz
    found_hz = shown_hz(expected_hz, bursts(true_hz, 3.0, 20 + int(4000 / true_hz)), NOISE)
    assert found_hz == pytest.approx(expected_hz if abs(factor - 1) < 1e-3 else true_hz, rel=1e-3)


def test_another_light_does_not_hide_the_laser():
    lamp = bursts(100.0, 3.0, per_burst=800, width=0.5)
    laser = bursts(300.0, 3.0, per_burst=200)
    assert shown_hz(300.0, lamp, laser, NOISE) == 300.0
    # A lamp with eight times the events, seen for a fifth of a second.
    bright = bursts(100.0, 0.2, per_burst=12_000, width=0.5)
    assert shown_hz(70.0, bright, bursts(70.0, 0.2, per_burst=2_000)) == 70.0
    assert shown_hz(70.0, bright) == pytest.approx(100.0, rel=0.01)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("expected_hz", [70.0, 72.0])
def test_a_flash_does_not_hide_the_laser(expected_hz, seed):
    """Most pixels of a sensor fire once, within some milliseconds, as a lamp is switched on."""
    rng = np.random.default_rng(seed)
    flash = rng.uniform(0.1, 0.8) * 1e6 + rng.uniform(0.0, 3000.0, 800_000)
    found_hz = shown_hz(expected_hz, bursts(70.0, 0.9, 10_000), flash.astype(np.int64), NOISE)
    assert found_hz == pytest.approx(70.0, rel=5e-3)


def test_events_without_rhythm_show_none():
    assert shown_hz(70.0, NOISE) is None
    assert shown_hz(70.0, np.arange(0, 2_000_000, 10)) is None
    assert FrequencyEstimate().frequency_hz(70.0) is None


def test_a_light_that_is_switched_on_and_off_has_no_frequency():
    background = np.random.default_rng(7).integers(0, 230_000, 10_000)
    lit = np.random.default_rng(8).integers(48_000, 180_000, 700_000)
    assert shown_hz(20_000.0, background, lit) is None
