"""Columns that are short, constant, hot, tied or cut by the sensor's edge."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from line_events import encoded
from reconstructing import reconstruct

from eschorty_ros.core.evt3 import sort_readout
from eschorty_ros.core.line import METHODS, SIGMA_FLOOR_PX, estimate
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import Settings

SEED = 20


# Least sigma of a row without spread.
LONE_SIGMA_PX = np.sqrt(1.0 / 12.0 + SIGMA_FLOOR_PX**2)
AVERAGES = ("mean", "mode_mean")
every_method = pytest.mark.parametrize("method", METHODS)


def one_column(rows, method="mode_mean", **options):
    values = np.asarray(rows)
    return estimate(values, [0, values.size], method, **options)


@pytest.mark.parametrize("method", AVERAGES)
@pytest.mark.parametrize("sigma_px", [0.3, 0.05])
@pytest.mark.parametrize("row", [700.0, 40.0])
@pytest.mark.hard_case(4)
def test_variance_of_a_narrow_line_far_from_row_0(method, sigma_px, row, measured):
    """In float32 E[x^2] - E[x]^2 would be wrong 12-fold and 740-fold here."""
    rng = np.random.default_rng(SEED)
    rows = np.rint(rng.normal(row + 0.45, sigma_px, 400)).astype(np.int64)
    assert np.unique(rows).size > 1
    found = one_column(rows, method)
    n, total = rows.size, int(rows.sum())
    exact = Fraction(n * int((rows * rows).sum()) - total * total, n * (n - 1))
    with mpmath.workdps(50):
        width = mpmath.sqrt(mpmath.mpf(exact.numerator) / exact.denominator)
        error = float(abs(mpmath.mpf(float(found.width[0])) / width - 1))
    measured("standard deviation of the rows, relative", error, 1e-15)
    measured("mean row, relative", abs(Fraction(float(found.row[0])) * n / total - 1), 1e-15)


@every_method
@pytest.mark.parametrize("row", [0, 300, 719])
@pytest.mark.parametrize("events", [1, 7])
@pytest.mark.hard_case(5)
def test_one_event_or_one_row_has_a_floor_in_sigma(method, row, events, measured):
    found = one_column([row] * events, method)
    assert found.row[0] == pytest.approx(row, abs=1e-9)
    shortfall = LONE_SIGMA_PX - float(found.sigma_row[0])
    measured("sigma below sqrt(1/12 + floor^2), px", shortfall, 1e-15)


@every_method
@pytest.mark.hard_case(5)
def test_no_event_is_nan_without_warning(method):
    found = estimate(np.empty(0, np.uint16), np.zeros(4, int), method)
    for values in (found.row, found.sigma_row, found.width):
        assert np.isnan(values).all()
    assert (found.events == 0).all()


@every_method
@pytest.mark.parametrize("events", [2, 50, 4000])
@pytest.mark.parametrize("row", [1, 699, 718])
@pytest.mark.hard_case(6)
def test_constant_column_has_exactly_no_spread(method, events, row):
    found = one_column([row] * events, method)
    assert found.width[0] == 0.0
    assert found.row[0] == pytest.approx(row, abs=1e-9)


@every_method
@pytest.mark.hard_case(11)
def test_seventy_thousand_events_on_one_pixel(method):
    rows = np.concatenate([np.full(70_000, 719), np.full(10, 0)])
    found = one_column(rows, method)
    if method == "mean":
        assert found.row[0] == 719 * 70_000 / 70_010
        assert found.events[0] == 70_010
    else:
        assert found.row[0] == pytest.approx(719.0, abs=0.01)
        assert found.events[0] >= 70_000


@pytest.mark.hard_case(11)
def test_hot_pixel_in_a_stream_is_counted_not_wrapped():
    """Twice more events than 16 bits hold, on one pixel, within one period."""
    n = 140_000
    t = np.sort(np.random.default_rng(SEED).integers(1000, 60_000, n))
    data = encoded(sort_readout(t, np.full(n, 640), np.full(n, 719), np.ones(n, np.uint8)))
    wanted = Settings(smoothing_half_width=0)
    found, reconstructor = reconstruct(data, Modulation(16.0, on_edge_us=500), wanted)
    counts = reconstructor.counters
    assert (counts["events"], len(found)) == (n, 1)
    assert counts["events_over_column_limit"] == n - wanted.column_limit
    assert (found.row[0], found.events[0]) == (719.0, wanted.column_limit)


@every_method
@pytest.mark.hard_case(22)
def test_rows_without_events_inside_a_line(method):
    """A log fit of the histogram would take log 0; no estimator here takes logs of counts."""
    rng = np.random.default_rng(SEED)
    sparse = 2 * np.rint(rng.normal(150.0, 2.0, (200, 12))).astype(np.int64)
    found = estimate(sparse.ravel(), np.arange(201) * 12, method, line_width_px=10.0)
    assert np.isfinite(found.row).all()
    assert np.isfinite(found.sigma_row).all()
    assert np.abs(found.row - 300.0).max() < 8.0


TIED = {
    "two equal groups": [100, 100, 100, 600, 600, 600],
    "two overlapping groups": [300, 300, 300, 309, 309, 309],
    "comb": list(range(200, 320, 8)),
    "plateau": [*range(300, 340)],
    "pair of pairs": [200, 201, 240, 241],
    "three groups": [100] * 4 + [300] * 4 + [500] * 4,
    "edges of the sensor": [0, 0, 719, 719],
}


@every_method
@pytest.mark.parametrize("rows", TIED.values(), ids=TIED)
@pytest.mark.parametrize("width", [2.0, 7.0, 20.0])
@pytest.mark.hard_case(23)
def test_ties_reverse_with_the_rows(method, rows, width, measured):
    values = np.array(rows)
    a = one_column(values, method, line_width_px=width)
    b = one_column(719 - values[::-1], method, line_width_px=width)
    assert np.isnan(a.row[0]) == np.isnan(b.row[0])
    assert a.ambiguous[0] == b.ambiguous[0]
    difference = np.nan_to_num(np.abs(a.row + b.row - 719.0)).max()
    measured("reversed rows against the reversed result, px", difference, 1e-12)


@pytest.mark.parametrize("edge", [0, 719])
@pytest.mark.parametrize("sigma_px", [4.0, 8.0])
@pytest.mark.hard_case(24)
def test_line_cut_in_half_is_off_by_the_truncated_normal(edge, sigma_px, measured):
    """Half a Gaussian has its mean at sqrt(2/pi) sigma: flagged, and covered by the sigma."""
    rng = np.random.default_rng(SEED)
    away = np.abs(rng.normal(0.0, sigma_px, (200, 400)))
    rows = np.abs(edge - np.clip(np.floor(away), 0, 719).astype(np.int64))
    width_px = 2.355 * sigma_px
    found = estimate(rows.ravel(), np.arange(201) * 400, "mean", line_width_px=width_px)
    bias = np.abs(found.row.mean() - edge)
    expected = np.sqrt(2.0 / np.pi) * sigma_px - 0.5
    measured("bias against 0.8 sigma, px", abs(bias - expected), 0.02 * sigma_px)
    assert found.edge.all()
    assert (np.abs(found.row - edge) < 3.0 * found.sigma_row).all()
    assert (np.abs(found.row - edge) > 0.5 * found.sigma_row).all()
    # It may be less than half of a wider line.
    wider = estimate(rows.ravel(), np.arange(201) * 400, "mean", line_width_px=2.0 * width_px)
    assert (wider.sigma_row > 1.5 * found.sigma_row).all()


@every_method
@pytest.mark.hard_case(24)
def test_flag_is_for_cut_lines_only(method):
    rng = np.random.default_rng(SEED)
    middle = np.rint(rng.normal(350.0, 5.0, 60)).astype(int)
    cut = np.abs(np.rint(rng.normal(0.0, 5.0, 60))).astype(int)
    rows = np.concatenate([middle, cut, 719 - cut])
    found = estimate(rows, [0, 60, 120, 180, 180], method)
    assert found.edge.tolist() == [False, True, True, False]
    assert found.sigma_row[1] > 3.0 * found.sigma_row[0]
    # Of a line beyond the edge one row is left.
    last = estimate(np.full(50, 719), [0, 50], method)
    assert last.edge.all()
