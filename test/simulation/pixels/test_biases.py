"""What biases do is monotone, in the direction the sensor's maker gives."""

import numpy as np
import pytest
from eschorty_experiments._line_bench import LineEvents, simulate_line

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixels import LIMITS, Biases, parameters_from_biases, preset

SEED = 6
PAPER = preset("paper")


def bench(biases: Biases, frequency_hz: float, seconds: float) -> LineEvents:
    print(f"seed {SEED}")
    return simulate_line(
        parameters_from_biases(PAPER, biases), Modulation(frequency_hz), round(seconds * 1e6),
        columns=24, line_row=40.0, rows=81, seed=SEED,
    )  # fmt: skip


def test_no_offset_changes_nothing() -> None:
    assert parameters_from_biases(PAPER, Biases()) == PAPER


def test_thresholds_thin_out_the_events_and_narrow_the_line() -> None:
    for name, polarity in (("diff_on", 1), ("diff_off", 0)):
        low, high = LIMITS[name]
        runs = [bench(Biases(**{name: int(b)}), 70.0, 0.1) for b in np.linspace(low, high, 5)]
        counts = [int(np.sum(e.p == polarity)) for e in runs]
        widths = [float(np.std(e.y[e.p == polarity])) for e in runs]
        assert counts == sorted(counts, reverse=True), name
        assert widths == sorted(widths, reverse=True), name
        assert counts[-1] < 0.7 * counts[0]


def test_a_wider_follower_hastens_events_and_keeps_more_at_10_khz() -> None:
    offsets = (-35, -12, 10, 55)
    counts = [len(bench(Biases(fo=fo), 10_000.0, 0.02)) for fo in offsets]
    assert counts == sorted(counts)
    assert counts[-1] > 1.3 * counts[0]
    first = [bench(Biases(fo=fo), 70.0, 1.0 / 140.0) for fo in offsets]
    delay_us = [float(np.median(e.t[e.p == 1])) for e in first]
    assert delay_us == sorted(delay_us, reverse=True)
    assert delay_us[0] - delay_us[-1] > 10.0


def test_a_shorter_refractory_time_gives_more_events_at_2_khz() -> None:
    counts = [len(bench(Biases(refr=refr), 2000.0, 0.03)) for refr in (-20, 40, 110, 235)]
    assert counts == sorted(counts)
    assert counts[-1] > 1.5 * counts[0]


@pytest.mark.parametrize(("name", "value"), [("diff_on", -86), ("fo", 56), ("refr", -21)])
def test_offsets_outside_the_range_are_refused(name: str, value: int) -> None:
    with pytest.raises(ArgumentError, match=f"{name} is {value}"):
        Biases(**{name: value})
