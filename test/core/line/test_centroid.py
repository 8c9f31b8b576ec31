"""Column estimators against known rows, their bounds and their symmetries."""

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.line import (
    FULL_COLUMN_METHODS,
    METHODS,
    SIGMA_FLOOR_PX,
    estimate,
)

SEED = 20260
WINDOWED = [name for name in METHODS if name not in FULL_COLUMN_METHODS]


def drawn(fwhm: float, events: int, share: float, columns: int = 3000):
    rng = np.random.default_rng(SEED)
    truth = rng.uniform(200, 520, columns)
    rows = rng.normal(truth[:, None], fwhm / 2.3548, (columns, events))
    noise = rng.random((columns, events)) < share
    rows = np.where(noise, rng.uniform(-0.5, 719.5, (columns, events)), rows)
    rows = np.clip(np.rint(rows), 0, 719).astype(np.uint16)
    return truth, rows.ravel(), np.arange(columns + 1) * events


@pytest.mark.parametrize(
    ("fwhm", "events", "share"),
    [(2, 30, 0.3), (10, 30, 0.1), (20, 30, 0.0), (20, 100, 0.1), (20, 200, 0.3), (2, 200, 0.1)],
)
def test_error_stays_near_the_cramer_rao_bound(fwhm, events, share):
    truth, rows, offsets = drawn(fwhm, events, share)
    found = estimate(rows, offsets, line_width_px=fwhm)
    sigma = fwhm / 2.3548
    bound = np.sqrt(sigma**2 + 1 / 12) / np.sqrt(events * (1 - share))
    error = np.quantile(np.abs(found.row - truth), 0.6827)
    assert error < 1.1 * bound, f"seed {SEED}: {error / bound:.3f} x bound"


@pytest.mark.parametrize("method", WINDOWED)
@pytest.mark.parametrize("fwhm", [5, 20])
def test_gross_errors_with_few_events_and_much_background(method, fwhm):
    truth, rows, offsets = drawn(fwhm, 10, 0.3)
    found = estimate(rows, offsets, method, line_width_px=fwhm)
    gross = ~(np.abs(found.row - truth) < 2 * fwhm)
    assert gross.mean() <= 0.015, f"seed {SEED}"


@pytest.mark.parametrize("method", WINDOWED)
@pytest.mark.parametrize("row", [0.0, 5.0, 12.0, 719.0])
def test_sigma_covers_the_bias_of_a_line_cut_by_the_sensor(method, row):
    """The part on the sensor has its mean up to 0.8 sigma inside."""
    rng = np.random.default_rng(SEED)
    sigma, events, columns = 8.493, 100, 1500
    rows = np.rint(rng.normal(row, sigma, (columns, 4 * events)))
    rows = np.stack([line[(line >= 0) & (line <= 719)][:events] for line in rows]).astype(int)
    offsets = np.arange(columns + 1) * events
    found = estimate(rows.ravel(), offsets, method, line_width_px=20.0, sigma_factor=1.0)
    error = found.row - row
    assert found.edge.mean() > 0.95, f"seed {SEED}"
    assert np.mean(np.abs(error) < 2 * found.sigma_row) > 0.95, f"seed {SEED}"


def test_every_method_gives_a_row_of_its_own():
    rows = np.repeat([300, 301, 302, 304, 306, 309, 340], [9, 8, 7, 3, 2, 1, 2])
    found = [float(estimate(rows, [0, rows.size], method=name).row[0]) for name in METHODS]
    assert len(set(found)) == len(METHODS), dict(zip(METHODS, found, strict=True))
    assert found[METHODS.index("mean")] == pytest.approx(rows.mean())
    assert found[METHODS.index("median")] == pytest.approx(np.median(rows), abs=0.5)


def test_sigma_has_a_floor_and_grows_with_events_beyond_the_line():
    line = np.arange(290, 311).repeat(2)
    sigma = {}
    for background in (0, 1, 3):
        rows = np.concatenate([line, np.linspace(20, 700, background).astype(int)])
        found = estimate(rows, [0, rows.size], "mean")
        error = found.row[0] - 300.0
        assert abs(error) <= 2.0 * found.sigma_row[0], background
        sigma[background] = found.sigma_row[0]
    assert sigma[0] == pytest.approx(SIGMA_FLOOR_PX, rel=1e-12)
    assert sigma[0] < sigma[1] < sigma[3]
    independent = estimate(line, [0, line.size], "mean", sigma_factor=1.0)
    expected = np.sqrt(SIGMA_FLOOR_PX**2 + line.var(ddof=1) / line.size)
    assert independent.sigma_row[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("offsets", [[0, 1], [0, 3], [1, 2], [0, 2, 1, 2]])
def test_offsets_that_do_not_cover_the_rows_are_refused(offsets):
    with pytest.raises(ArgumentError, match="offsets run from"):
        estimate([300, 301], offsets)
