"""What no column estimator may depend on: place, direction, order and number of copies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.line import FULL_COLUMN_METHODS, METHODS, RETURNS, estimate

ROWS = 720
WINDOWED = [name for name in METHODS if name not in FULL_COLUMN_METHODS]
POLICIES = [(method, "strongest") for method in METHODS] + [
    (method, returns) for method in WINDOWED for returns in RETURNS if returns != "strongest"
]
MIRRORED = {"first": "last", "last": "first"}
WIDTHS = [2.0, 7.0, 20.0]
many = settings(derandomize=True, max_examples=60, deadline=None)


@st.composite
def columns(draw, low=0, high=ROWS - 1):
    """One or two lines, from tied and narrow to wide, on some background."""
    rows = draw(st.lists(st.integers(low, high), max_size=25))
    for _ in range(draw(st.integers(1, 2))):
        centre = draw(st.integers(low, high))
        spread = draw(st.sampled_from([0, 1, 4, 12]))
        offsets = draw(st.lists(st.integers(-spread, spread), min_size=1, max_size=60))
        rows += [min(max(centre + offset, low), high) for offset in offsets]
    return np.array(rows)


def one(rows, method, returns="strongest", width=7.0):
    return estimate(rows, [0, len(rows)], method, returns=returns, line_width_px=width)


@pytest.mark.parametrize(("method", "returns"), POLICIES)
@many
@given(rows=columns(), width=st.sampled_from(WIDTHS))
def test_mirrored_rows_give_the_mirrored_result(method, returns, rows, width):
    a = one(rows, method, returns, width)
    b = one(ROWS - 1 - rows, method, MIRRORED.get(returns, returns), width)
    turned = (slice(None), slice(None, None, -1)) if returns == "all" else slice(None)
    row, sigma, events = b.row[turned], b.sigma_row[turned], b.events[turned]
    if returns == "all" and np.isnan(a.row[0, 1]):
        row, sigma, events = b.row, b.sigma_row, b.events
    np.testing.assert_allclose(row, ROWS - 1 - a.row, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sigma, a.sigma_row, rtol=1e-12)
    np.testing.assert_array_equal(events, a.events)
    np.testing.assert_array_equal(b.ambiguous, a.ambiguous)


@pytest.mark.parametrize(("method", "returns"), POLICIES)
@many
@given(rows=columns(150, 450), width=st.sampled_from(WIDTHS), shift=st.integers(-90, 190))
def test_shifted_rows_shift_the_result(method, returns, rows, width, shift):
    a = one(rows, method, returns, width)
    b = one(rows + shift, method, returns, width)
    np.testing.assert_allclose(b.row, a.row + shift, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(b.events, a.events)
    np.testing.assert_allclose(b.width, a.width, rtol=1e-15)


@pytest.mark.parametrize(("method", "returns"), POLICIES)
@many
@given(rows=columns(), width=st.sampled_from(WIDTHS), random=st.randoms(use_true_random=False))
def test_order_of_events_does_not_matter(method, returns, rows, width, random):
    shuffled = rows.tolist()
    random.shuffle(shuffled)
    a = one(rows, method, returns, width)
    b = one(np.array(shuffled), method, returns, width)
    np.testing.assert_array_equal(a.row, b.row)
    np.testing.assert_array_equal(a.sigma_row, b.sigma_row)
    np.testing.assert_array_equal(a.events, b.events)


@pytest.mark.parametrize("method", METHODS)
@many
@given(rows=columns(60, ROWS - 61), width=st.sampled_from(WIDTHS), copies=st.integers(2, 5))
def test_copies_of_all_events_leave_the_row(method, rows, width, copies):
    """A column that gives a row still gives it; more events can only make a line stand out."""
    a = one(rows, method, width=width)
    b = one(np.repeat(rows, copies), method, width=width)
    if np.isfinite(a.row[0]):
        np.testing.assert_allclose(b.row, a.row, rtol=0, atol=1e-12)
        assert b.events[0] == copies * a.events[0]


@pytest.mark.parametrize("method", WINDOWED)
@many
@given(rows=columns(), width=st.sampled_from(WIDTHS))
def test_policies_agree_on_the_same_returns(method, rows, width):
    both = one(rows, method, "all", width)
    first, last = one(rows, method, "first", width), one(rows, method, "last", width)
    strongest = one(rows, method, "strongest", width)
    seen = both.row[np.isfinite(both.row)]
    np.testing.assert_array_equal(first.row, both.row[:, 0])
    np.testing.assert_array_equal(last.row, seen[-1:] if seen.size else [np.nan])
    assert (np.diff(seen) >= 2.0 * width - 1.0).all()
    if seen.size == 1:
        np.testing.assert_array_equal(strongest.row, seen)
    if strongest.ambiguous[0]:
        assert seen.size == 2
