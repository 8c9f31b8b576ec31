"""The pixel model with noise: against a finely stepped reference, and the regimes of the paper."""

import math

import numpy as np
import pytest
from eschorty_experiments._line_bench import LineEvents, simulate_line
from eschorty_experiments._line_width import full_width_half_maximum as fwhm
from pixel_reference import stepped

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixels import PixelParameters

SEED = 5
ROWS, CENTRE = 81, 40.0
PAPER = PixelParameters()

# PHYSICS section 8, P*: events per second and column, 81 rows simulated.
TABLE = {50: 2179, 200: 8428, 500: 19617, 1000: 19222, 2000: 23067, 5000: 20217, 10_000: 14956}


def bench(frequency_hz: float, seconds: float, columns: int = 32, **options) -> LineEvents:
    return simulate_line(
        options.pop("parameters", PAPER), Modulation(frequency_hz), round(seconds * 1e6),
        columns=columns, line_row=CENTRE, rows=ROWS, seed=SEED, **options,
    )  # fmt: skip


def rate(events: LineEvents, seconds: float) -> float:
    """Events per second and column."""
    return len(events) / events.truth_row.size / seconds


@pytest.mark.parametrize(
    ("frequency_hz", "seconds"),
    [(70.0, 0.1), (500.0, 0.04), (1000.0, 0.04), (5000.0, 0.03), (10_000.0, 0.03)],
)
def test_counts_and_widths_agree_with_fine_time_steps(frequency_hz: float, seconds: float) -> None:
    # Close to the cut-off a pixel's thresholds decide: there it takes many of them.
    columns = 12 if frequency_hz < 1e4 else 24
    near = np.arange(26, 55)
    offsets = np.tile(near - CENTRE, columns)
    reference = stepped(PAPER, frequency_hz, seconds, offsets, SEED)
    print(f"seed {SEED}, {len(reference)} events by steps")
    per_row = np.bincount(26 + reference[:, 1].astype(np.int64) % near.size, minlength=ROWS)
    per_row = per_row / columns
    events = bench(frequency_hz, seconds, columns=64)
    mine = np.bincount(events.y, minlength=ROWS) / 64
    assert mine.sum() == pytest.approx(per_row.sum(), rel=0.05)
    assert abs(fwhm(mine) - fwhm(per_row)) <= 1
    assert events.p.mean() == pytest.approx(reference[:, 2].mean(), abs=0.03)


def test_first_event_times_agree_with_fine_time_steps() -> None:
    prompt = PixelParameters(threshold_mismatch=0.0, latency_us=0.0, latency_jitter_us=0.0)
    events = bench(70.0, 1 / 70, columns=64, parameters=prompt)
    reference = stepped(prompt, 70.0, 1 / 70, np.tile([0.0, 5.0, 8.0], 200), SEED, 0.5)
    half_us = 5e5 / 70
    for polarity, start_us in ((1, 0.0), (0, half_us)):
        for k, row in enumerate((40, 45, 48)):
            here = (events.y == row) & (events.p == polarity) & (events.t < start_us + half_us)
            t = events.t[here] - start_us - 1.5
            of_pixel = (reference[:, 1] % 3 == k) & (reference[:, 2] == polarity)
            wanted = reference[of_pixel & (reference[:, 0] < start_us + half_us), 0] - start_us
            error = np.median(t) - np.median(wanted)
            spread = np.subtract(*np.percentile(wanted, [84, 16])) / 2.0
            print(polarity, row, np.median(wanted), error, spread)
            assert abs(error) < 1.0 + 3.0 * spread / math.sqrt(50.0)
            mine = np.subtract(*np.percentile(t, [84, 16])) / 2.0
            assert mine == pytest.approx(spread, rel=0.4, abs=0.7)


def test_regimes_follow_the_table() -> None:
    counted = {f: rate(bench(f, 0.1), 0.1) for f in TABLE}
    counted[20_000] = rate(bench(20_000.0, 0.05), 0.05)
    print(f"seed {SEED}: {counted}")
    for f, expected in TABLE.items():
        assert counted[f] == pytest.approx(expected, rel=0.15), f
    for f in (50, 200, 500):
        assert counted[f] / f == pytest.approx(counted[200] / 200, rel=0.12), f
    assert counted[1000] / counted[500] <= 1.5
    assert counted[20_000] / counted[1000] <= 0.25


def test_width_shrinks_from_20_rows_to_5() -> None:
    wide = {}
    for f, seconds in ((100.0, 0.1), (5000.0, 0.05), (10_000.0, 0.05), (20_000.0, 0.1)):
        wide[f] = fwhm(np.bincount(bench(f, seconds).y, minlength=ROWS))
    print(f"seed {SEED}: {wide}")
    assert abs(wide[100.0] - 20) <= 2
    assert [wide[5000.0], wide[10_000.0]] == pytest.approx([15, 11], abs=1)
    assert wide[20_000.0] <= 5


def test_a_step_to_black_shifts_the_centroid_as_the_paper_says() -> None:
    events = simulate_line(
        PAPER, Modulation(70.0), 500_000, columns=96, line_row=CENTRE + np.linspace(0, 1, 96),
        reflectance=np.full(96, 0.04), edge_offset_rows=0.0, reflectance_above=1.0, rows=ROWS,
        seed=SEED,
    )  # fmt: skip
    shift = float(np.mean(events.y - events.truth_row[events.x]))
    print(f"seed {SEED}: shift {shift:.2f} px")
    assert abs(shift - 3.75) <= 0.75


def test_noise_fires_early_and_widens_the_line() -> None:
    noisy = bench(70.0, 0.2)
    quiet = bench(70.0, 0.2, parameters=PixelParameters(noise=0.0))
    assert 1.03 < len(noisy) / len(quiet) < 1.2


def test_refractory_jitter_lifts_the_dip_at_1_khz_a_little() -> None:
    plain = rate(bench(1000.0, 0.1), 0.1)
    spread = PixelParameters(refractory_jitter=0.1)
    jittered = rate(bench(1000.0, 0.1, parameters=spread), 0.1)
    assert 1.005 < jittered / plain < 1.12


def test_leak_makes_on_events_everywhere() -> None:
    leaky = PixelParameters(leak_hz=2.0)
    events = simulate_line(
        leaky, Modulation(70.0), 500_000, columns=64, reflectance=0.0, rows=ROWS, seed=SEED
    )
    expected = 64 * ROWS
    assert abs(len(events) - expected) < 4.0 * math.sqrt(expected)
    assert events.p.all()
