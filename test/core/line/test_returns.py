"""Two surfaces in one column: which returns are reported, in which order, and their smoothing."""

import numpy as np
import pytest
from line_events import encoded, line_events
from reconstructing import reconstruct

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import sort_readout
from eschorty_ros.core.line import RETURNS, estimate
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Settings, place_link

SEED = 31
CALIBRATION = load_calibration("config_3")
WINDOWED = ("mode_mean", "learned")
NEAR, FAR = 250.0, 420.0
PERIODS, COLUMNS = 8, 200


def two_surfaces(far=lambda c: c >= 0, slope=0.0):
    """The near surface fills every column, the far one those that ``far`` names."""
    rng = np.random.default_rng(SEED)
    shared = {"periods": PERIODS, "columns": COLUMNS, "fwhm_px": 8.0}
    rows = lambda k, c: NEAR + slope * c, lambda k, c: np.where(far(c), FAR, np.nan)
    near = line_events(rng, rows[0], events=100.0, background=0.1, **shared)
    behind = line_events(rng, rows[1], events=115.0, background=0.0, **shared)
    return encoded(sort_readout(*(np.concatenate(v) for v in zip(near, behind, strict=True))))


def run(data, **settings):
    found, reconstructor = reconstruct(data, settings=Settings(column_limit=256, **settings))
    # The line's width is known after a few periods.
    return found.select(found.period >= 4), reconstructor.counters


@pytest.mark.parametrize("method", WINDOWED)
def test_each_policy_reports_its_surface(method):
    data = two_surfaces()
    for returns, row in (("strongest", FAR), ("first", NEAR), ("last", FAR)):
        found, _ = run(data, centroid=method, returns=returns)
        right = np.abs(found.row - row) < 5.0
        assert right.mean() > (0.9 if returns == "strongest" else 0.99), returns
        assert len(found) > 0.99 * 4 * COLUMNS
        assert (found.return_index == 0).all()


@pytest.mark.parametrize("method", WINDOWED)
def test_all_returns_come_by_period_column_and_range(method):
    found, counters = run(two_surfaces(), centroid=method, returns="all")
    order = np.lexsort((found.return_index, found.column, found.period))
    np.testing.assert_array_equal(order, np.arange(len(found)))
    first, second = found.select(found.return_index == 0), found.select(found.return_index == 1)
    assert len(second) > 0.98 * 4 * COLUMNS
    assert np.abs(second.row - FAR).max() < 5.0
    assert np.mean(np.abs(first.row - NEAR) < 5.0) > 0.98
    assert (first.range_mm.max() < second.range_mm).all()
    assert counters["columns_two_returns"] >= len(second)
    bound = 8.0 / 2.3548 / np.sqrt(found.events.mean())
    for part, row in ((first.select(np.abs(first.row - NEAR) < 5.0), NEAR), (second, FAR)):
        assert abs(np.mean(part.row - row)) < 4 * bound / np.sqrt(len(part) / 5), f"seed {SEED}"


def test_one_surface_gives_the_same_points_under_every_policy():
    data = two_surfaces(far=lambda c: c < 0)
    plain, _ = run(data)
    for returns in RETURNS[1:]:
        found, counters = run(data, returns=returns)
        np.testing.assert_array_equal(found.row, plain.row)
        np.testing.assert_allclose(found.sigma_row, plain.sigma_row, rtol=1e-12)
        np.testing.assert_array_equal(found.return_index, plain.return_index)
        assert counters["columns_two_returns"] == 0


def test_smoothing_follows_each_surface_and_mixes_none():
    """The far surface begins at column 100: there the near one changes from only to first."""
    data = two_surfaces(far=lambda c: c >= 100, slope=0.3)
    raw, _ = run(data, returns="all", smoothing_half_width=0)
    smooth, _ = run(data, returns="all", smoothing_half_width=3, smoothing_gate_px=100.0)
    np.testing.assert_array_equal(raw.column, smooth.column)
    off_near = raw.row - NEAR - 0.3 * raw.column
    near_raw = np.abs(off_near) < 8.0
    error_raw = np.where(near_raw, off_near, raw.row - FAR)
    error = smooth.row - raw.row + error_raw
    real = np.abs(error_raw) < 8.0
    assert real.mean() > 0.99
    assert np.abs(error[real]).max() < 8.0
    assert error[real].std() < 0.6 * error_raw[real].std()
    edge = real & near_raw & (np.abs(raw.column.astype(int) - 100) <= 3)
    assert error[edge].std() < 0.7 * error_raw[edge].std()


def test_ambiguous_columns_under_each_policy():
    rows = np.array([100, 101, 102, 600, 601, 602])
    given = {name: estimate(rows, [0, 6], returns=name, line_width_px=5.0) for name in RETURNS}
    assert np.isnan(given["strongest"].row[0])
    assert given["strongest"].ambiguous[0]
    assert (given["first"].row[0], given["last"].row[0]) == (101.0, 601.0)
    assert given["all"].row[0].tolist() == [101.0, 601.0]
    assert not any(given[name].ambiguous[0] for name in RETURNS[1:])


@pytest.mark.parametrize("apart", [12.0, 16.0])
def test_one_broad_line_is_not_two_surfaces(apart):
    """Nearer than two widths: one line with a shoulder."""
    rng = np.random.default_rng(SEED)
    rows = np.hstack([rng.normal(300.0, 4.2, (500, 30)), rng.normal(300.0 + apart, 4.2, (500, 25))])
    rows = np.rint(rows).astype(int).ravel()
    found = estimate(rows, np.arange(501) * 55, returns="all", line_width_px=10.0)
    assert np.isfinite(found.row[:, 1]).mean() < 0.02, f"seed {SEED}"


def test_clouds_hold_both_returns():
    found, _ = run(two_surfaces(), returns="all")
    points = place_link(found, CALIBRATION.model())
    assert len(points) == len(found)
    both = found.column == 50
    assert np.unique(np.round(points["x"][both], 1)).size == 2


@pytest.mark.parametrize("method", ["mean", "median"])
def test_full_column_methods_do_not_separate_returns(method):
    for refused in (
        lambda: Settings(centroid=method, returns="all"),
        lambda: Settings(returns="all", reflectance_compensation="on"),
        lambda: estimate([1], [0, 1], method, returns="first"),
    ):
        with pytest.raises(ArgumentError, match="returns is") as caught:
            refused()
        assert "\n" not in str(caught.value)
