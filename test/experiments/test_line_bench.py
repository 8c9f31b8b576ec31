"""The line bench: a resting line on independent columns."""

import numpy as np
import pytest
from eschorty_experiments._line_bench import LineEvents, simulate_line

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixels import PixelParameters

SEED = 3
WAVE = Modulation(70.0)


def bench(**options) -> LineEvents:
    print(f"seed {SEED}")
    return simulate_line(PixelParameters(), WAVE, 100_000, seed=SEED, **options)


def centroid(events: LineEvents, columns: int) -> np.ndarray:
    count = np.bincount(events.x, minlength=columns)
    return np.bincount(events.x, weights=events.y, minlength=columns) / count


def test_line_lies_where_it_is_put_and_repeats_itself() -> None:
    rows = 300.0 + np.linspace(0.0, 5.0, 64)
    events = bench(line_row=rows)
    assert np.array_equal(events.truth_row, rows)
    assert np.mean(centroid(events, 64) - rows) == pytest.approx(0.0, abs=0.1)
    assert np.all(np.diff(events.t) >= 0)
    assert events.t[-1] < 100_000
    again = bench(line_row=rows)
    assert all(np.array_equal(getattr(events, n), getattr(again, n)) for n in "txyp")


def test_an_edge_without_contrast_changes_nothing_and_black_halves_the_footprint() -> None:
    plain = bench(columns=32)
    same = bench(columns=32, edge_offset_rows=0.3, reflectance_above=1.0)
    assert len(same) == pytest.approx(len(plain), rel=0.01)
    assert np.mean(centroid(same, 32)) == pytest.approx(np.mean(centroid(plain, 32)), abs=0.02)
    above = bench(columns=32, reflectance=0.0, edge_offset_rows=0.0, reflectance_above=1.0)
    assert above.y.min() >= 360
    # y+ / 2 = half of the bright half's width.
    assert np.mean(centroid(above, 32)) - 360.0 == pytest.approx(5.0, abs=0.6)


def test_the_step_mirrors() -> None:
    up = bench(columns=48, reflectance=0.1, edge_offset_rows=1.0, reflectance_above=1.0)
    down = bench(columns=48, reflectance=1.0, edge_offset_rows=-1.0, reflectance_above=0.1)
    shift = np.mean(centroid(up, 48)) - 360.0
    assert shift > 1.0
    assert shift == pytest.approx(360.0 - np.mean(centroid(down, 48)), abs=0.25)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"edge_offset_rows": 1.0}, "reflectance_above None"),
        ({"line_row": [1.0, 2.0]}, "line_row has shape"),
        ({"reflectance": np.nan}, "reflectance"),
        ({"reflectance": 1.5}, "reflectance"),
    ],
)
def test_impossible_benches_are_refused(options: dict[str, object], match: str) -> None:
    with pytest.raises(ArgumentError, match=match):
        bench(**options)
