"""Column estimators against known rows, their bounds and their symmetries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.centroid import METHODS, estimate
from eschorty_ros.core.errors import ArgumentError

SEED = 20260


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
    [(2, 30, 0.3), (10, 30, 0.3), (20, 30, 0.0), (20, 100, 0.05), (20, 200, 0.3), (2, 200, 0.1)],
)
def test_mode_mean_stays_near_the_cramer_rao_bound(fwhm, events, share):
    truth, rows, offsets = drawn(fwhm, events, share)
    found = estimate(rows, offsets, line_width_px=fwhm)
    sigma = fwhm / 2.3548
    bound = np.sqrt(sigma**2 + 1 / 12) / np.sqrt(events * (1 - share))
    error = np.quantile(np.abs(found.row - truth), 0.6827)
    assert error < 1.1 * bound, f"seed {SEED}: {error / bound:.3f} x bound"


def test_gross_errors_with_few_events_and_much_background():
    truth, rows, offsets = drawn(5, 10, 0.3)
    found = estimate(rows, offsets, line_width_px=5)
    gross = ~(np.abs(found.row - truth) < 10)
    assert gross.mean() <= 0.015, f"seed {SEED}"


def test_stronger_of_two_surfaces_wins():
    rng = np.random.default_rng(SEED)
    strong = np.rint(rng.normal(300, 4.0, (500, 60))).astype(int)
    weak = np.rint(rng.normal(420, 4.0, (500, 40))).astype(int)
    rows = np.hstack([weak, strong])
    found = estimate(rows.ravel(), np.arange(501) * 100, line_width_px=10)
    assert np.abs(found.row - 300).max() < 4.0


column_rows = st.lists(st.integers(0, 719), min_size=1, max_size=300)


@settings(derandomize=True, max_examples=150, deadline=None)
@given(column_rows, st.sampled_from(METHODS), st.sampled_from([2.0, 7.0, 20.0]))
def test_mirrored_rows_give_the_mirrored_result(rows, method, width):
    values = np.array(rows)
    offsets = [0, len(rows)]
    a = estimate(values, offsets, method, line_width_px=width)
    b = estimate(719 - values, offsets, method, line_width_px=width)
    np.testing.assert_allclose(b.row, 719 - a.row, rtol=0, atol=1e-12)
    np.testing.assert_allclose(b.sigma_row, a.sigma_row, rtol=1e-12)
    np.testing.assert_array_equal(b.events, a.events)


@settings(derandomize=True, max_examples=80, deadline=None)
@given(column_rows, st.sampled_from(METHODS), st.randoms(use_true_random=False))
def test_order_of_events_does_not_matter(rows, method, random):
    shuffled = list(rows)
    random.shuffle(shuffled)
    a = estimate(rows, [0, len(rows)], method)
    b = estimate(shuffled, [0, len(rows)], method)
    np.testing.assert_array_equal(a.row, b.row)
    np.testing.assert_array_equal(a.sigma_row, b.sigma_row)


@settings(derandomize=True, max_examples=80, deadline=None)
@given(st.lists(st.integers(100, 400), min_size=1, max_size=60), st.integers(-100, 300))
def test_shifted_rows_shift_the_result(rows, shift):
    values = np.array(rows)
    a = estimate(values, [0, len(rows)], line_width_px=5.0)
    b = estimate(values + shift, [0, len(rows)], line_width_px=5.0)
    np.testing.assert_allclose(b.row, a.row + shift, rtol=0, atol=1e-12)


def test_two_equal_separate_groups_are_left_undecided():
    found = estimate([100, 100, 100, 600, 600, 600], [0, 6], line_width_px=5.0)
    assert np.isnan(found.row[0])
    assert found.ambiguous[0]


def test_sigma_follows_the_error_model():
    rng = np.random.default_rng(SEED)
    rows = np.rint(rng.normal(300, 5, 50)).astype(int)
    found = estimate(rows, [0, 50], "mean")
    expected = np.sqrt(0.24**2 * rows.var(ddof=1) / 50 + 0.2**2)
    assert found.sigma_row[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("rows", "offsets", "options"),
    [
        ([1, 720], [0, 2], {}),
        ([-1], [0, 1], {}),
        ([1.5], [0, 1], {}),
        ([1], [0, 2], {}),
        ([1, 2], [0, 2, 1, 2], {}),
        ([1], [0, 1], {"method": "best"}),
        ([1], [0, 1], {"line_width_px": float("nan")}),
        ([1], [0, 1], {"height": 5000}),
    ],
)
def test_bad_arguments_are_refused(rows, offsets, options):
    with pytest.raises(ArgumentError) as caught:
        estimate(rows, offsets, **options)
    assert "\n" not in str(caught.value)
