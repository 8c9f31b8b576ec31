"""Closed form and definition of the line width."""

import math
from dataclasses import replace

import numpy as np
import pytest
from eschorty_experiments._line_width import (
    closed_form_width,
    full_width_half_maximum,
    measure,
    swing,
)

from eschorty_ros.simulation.pixels import preset

PAPER = preset("paper")
CLOSED_FORM_PX = {
    50: 20.0, 100: 20.0, 200: 20.0, 350: 20.0, 500: 20.0, 700: 19.9, 1000: 19.7, 2000: 18.7,
    5000: 15.7, 10_000: 12.2, 14_000: 9.6, 20_000: 4.9,
}  # fmt: skip


@pytest.mark.parametrize(("frequency_hz", "width_px"), CLOSED_FORM_PX.items())
def test_closed_form_width_of_the_paper_preset(frequency_hz, width_px):
    assert closed_form_width(PAPER, frequency_hz) == pytest.approx(width_px, abs=0.06)


def test_the_width_at_low_frequency_is_limited_by_contrast():
    ratio = PAPER.amplitude / PAPER.background_intensity / math.expm1(PAPER.threshold_on)
    expected = 2.0 * PAPER.sigma_rows * math.sqrt(2.0 * math.log(ratio))
    assert closed_form_width(PAPER, 16.0) == pytest.approx(expected, rel=1e-6)


def test_nothing_fires_beyond_the_cut_off():
    assert closed_form_width(PAPER, 40_000.0) == 0.0


@pytest.mark.parametrize("frequency_hz", [70.0, 1000.0, 12_000.0])
def test_swing_is_that_of_the_photoreceptor(frequency_hz):
    """Against the differential equation, stepped finely over many periods."""
    contrast, steps = 3.0, 20_000
    rate = 2.0 * math.pi * PAPER.bandwidth_hz
    half_s = 0.5 / frequency_hz
    dt = half_s / steps
    v, ends = 0.0, []
    for light in (1.0 + contrast, 1.0) * 12:
        for _ in range(steps):
            slope = rate * (light - math.exp(v))
            v += dt * rate * (light - math.exp(v + 0.5 * dt * slope))
        ends.append(v)
        if len(ends) > 4 and abs(ends[-1] - ends[-3]) < 1e-9:
            break
    pole = math.hypot(1.0, frequency_hz / PAPER.follower_hz)
    found = abs(ends[-1] - ends[-2]) / pole
    assert swing(PAPER, frequency_hz, contrast) == pytest.approx(found, rel=1e-5)


@pytest.mark.parametrize(
    ("counts", "width_px"),
    [([0, 0, 0, 0], 0), ([0, 9, 9, 9, 0], 3), ([0, 4, 9, 9, 9, 5, 0], 4),
     ([5, 0, 9, 9, 9, 0, 0], 5), ([0, 0, 6, 0, 0], 1)],
)  # fmt: skip
def test_width_spans_the_bins_that_reach_half(counts, width_px):
    assert full_width_half_maximum(np.array(counts)) == width_px


@pytest.mark.parametrize("frequency_hz", [70.0, 300.0])
def test_a_simulated_line_is_as_wide_as_the_closed_form(frequency_hz):
    quiet = replace(PAPER, noise=0.0, threshold_mismatch=0.0)
    point = measure(quiet, frequency_hz, columns=32, periods=20, seed=3)
    expected = closed_form_width(quiet, frequency_hz)
    assert np.mean(point.widths_px) == pytest.approx(expected, abs=0.3)
