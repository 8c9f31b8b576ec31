"""Named parameter sets."""

import numpy as np
import pytest
from eschorty_experiments._line_bench import LineEvents, simulate_line
from eschorty_experiments._line_width import full_width_half_maximum as fwhm

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixels import PRESETS, PixelParameters, preset

SEED = 9


def bench(name: str, frequency_hz: float, seconds: float, columns: int = 32) -> LineEvents:
    print(f"seed {SEED}")
    line = 40.0 + np.linspace(-0.5, 0.5, columns)
    return simulate_line(
        preset(name), Modulation(frequency_hz), round(seconds * 1e6), columns=columns,
        line_row=line, rows=81, seed=SEED,
    )  # fmt: skip


def rate_hz(events: LineEvents, seconds: float) -> float:
    return len(events) / events.truth_row.size / seconds


def median_fwhm(events: LineEvents) -> float:
    """Median over the columns."""
    rows = [events.y[events.x == column] for column in range(events.truth_row.size)]
    return float(np.median([fwhm(np.bincount(y, minlength=81)) for y in rows]))


def test_narrow_reaches_two_rows_at_20_khz_and_keeps_the_regimes() -> None:
    wide = [
        median_fwhm(bench("narrow", f, s))
        for f, s in ((50.0, 0.2), (1000.0, 0.06), (5000.0, 0.03), (10_000.0, 0.03), (2e4, 0.1))
    ]
    print(wide)
    assert abs(wide[0] - 20.0) <= 2.0
    assert wide[-1] == pytest.approx(2.0, abs=0.5)
    assert wide == sorted(wide, reverse=True)
    seconds = {50.0: 0.2, 200.0: 0.1, 500.0: 0.1, 1000.0: 0.06, 20_000.0: 0.1}
    count = {f: rate_hz(bench("narrow", f, s), s) for f, s in seconds.items()}
    print(count)
    for f in (50.0, 200.0, 500.0):
        assert count[f] / f == pytest.approx(count[200.0] / 200.0, rel=0.12)
    assert count[1000.0] / count[500.0] <= 1.5
    assert count[20_000.0] / count[1000.0] <= 0.25


def test_ideal_pixels_answer_every_edge_exactly_once() -> None:
    events = bench("ideal", 70.0, 1.0 / 7.0, columns=16)
    counts = np.unique(events.x.astype(np.int64) * 81 + events.y, return_counts=True)[1]
    assert set(counts.tolist()) == {20}
    assert events.p.mean() == 0.5


def test_noisy_pixels_scatter_more_than_those_of_the_paper() -> None:
    def scatter(name: str) -> float:
        events = bench(name, 70.0, 0.2, columns=64)
        near = np.abs(events.y - events.truth_row[events.x]) < 20
        x, y = events.x[near], events.y[near]
        rows = np.bincount(x, weights=y, minlength=64) / np.bincount(x, minlength=64)
        return float(np.std(rows - events.truth_row))

    assert 1.1 * scatter("paper") < scatter("noisy")


def test_hot_pixels_fire_by_themselves() -> None:
    hot = PixelParameters(hot_fraction=1e-3, hot_hz=200.0)
    events = simulate_line(
        hot, Modulation(70.0), 500_000, columns=100, reflectance=0.0, rows=100, seed=SEED
    )
    counts = np.unique(events.x.astype(np.int64) * 100 + events.y, return_counts=True)[1]
    assert 2 <= counts.size <= 25
    assert counts.mean() == pytest.approx(100.0, rel=0.15)


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(ArgumentError, match="'papre'; choose one of paper, ideal, noisy, narrow"):
        preset("papre")
    assert PRESETS["paper"] == PixelParameters()
