"""Compiled column estimators: the windows of a column's returns, then the row in each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line._mode import (
    AMBIGUOUS,
    FOUND,
    TOO_FEW,
    Returns,
    _mode_search,
    _second_return,
    _side,
    _stands_out,
)
from eschorty_ros.core.line._row import (
    HALF_PER_SIGMA,
    Row,
    _edge_midpoint,
    _fill_likelihood,
    _gauss_ml,
    _mean,
    _median_row,
    _uncut_row,
    _variance,
    _whole_sigma2,
)
from eschorty_ros.core.line._sigma import Noise, _clipped2, _common2, _sigma2
from eschorty_ros.core.line._window import (
    FRACTION,
    ROW_LAST,
    _mean_shift,
    _padded,
    _whole_column,
)

# The methods up to MEAN are a window's mean.
MODE_MEAN, MEAN, MEDIAN, GAUSS_ML, EDGE_MID = 0, 1, 2, 3, 4
STRONGEST, FIRST, LAST, ALL = 0, 1, 2, 3
# A whole column wider than this many times the line's variance holds stray events.
_STRAYED = 1.5


class Estimator(NamedTuple):
    """Settings of an estimator.

    ``half_max`` is half a window's width for the line at its widest, fixed point, and
    ``line_variance`` the variance of its rows there. With ``seeded`` the search begins where the
    column's line was last, or its neighbour's is.
    """

    method: int
    returns: int
    seeded: bool
    events_min: int
    rows: int
    half_max: int
    line_variance: float
    noise: Noise


class Columns(NamedTuple):
    """Packed events by column: ``counts`` of them from ``starts`` on, with room for padding.

    ``seeds`` are the rows at which the lines were last, fixed point; -1 for none.
    """

    packed: NDArray[np.uint32]
    starts: NDArray[np.int64]
    counts: NDArray[np.uint32]
    seeds: NDArray[np.int64]


class Rows(NamedTuple):
    """The returns of each column, shape (returns, columns), NaN where there is none.

    A row's variance is ``sigma2``, which is the column's own, and ``common2``, which neighbours
    share. ``ambiguous`` has shape (columns,).
    """

    row: NDArray[np.float64]
    sigma2: NDArray[np.float64]
    common2: NDArray[np.float64]
    variance: NDArray[np.float64]
    events: NDArray[np.int64]
    mean_dt_us: NDArray[np.int64]
    cut: NDArray[np.bool_]
    ambiguous: NDArray[np.bool_]


class Scratch(NamedTuple):
    """Zeroed counts of 1024 rows, and room for the table of the likelihood."""

    row_counts: NDArray[np.int64]
    likelihood: NDArray[np.float64]


COUNTERS = np.dtype(
    [
        (name, np.int64)
        for name in (
            "events_binned",
            "events_before_first_edge",
            "events_outside_sensor",
            "events_over_column_limit",
            "events_gated",
            "periods_closed",
            "periods_empty",
            "columns_too_few_events",
            "columns_ambiguous",
            "columns_isolated",
            "columns_smoothed",
            "columns_two_returns",
        )
    ]
)


class Spread(NamedTuple):
    """Pooled sum of squares of the rows used and its degrees of freedom."""

    squares: float
    freedom: int


def empty_rows(returns: int, columns: int) -> Rows:
    """Return rows of ``columns`` columns that hold no return."""
    shape = returns, columns
    reals = np.full((4, *shape), np.nan)
    events, mean_dt_us = np.zeros((2, *shape), np.int64)
    cut, ambiguous = np.zeros(shape, np.bool_), np.zeros(columns, np.bool_)
    return Rows(*reals, events, mean_dt_us, cut, ambiguous)


@kernel
def _is_windowed(method):
    return method != MEAN and method != MEDIAN


@kernel
def _search(column, half, estimator):
    """Search a column for its window, without a seed."""
    if not _is_windowed(estimator.method):
        a = _whole_column(column)
        status = FOUND if column.events >= estimator.events_min else TOO_FEW
        return Returns(status, False, a, a)
    found = _mode_search(column, half)
    a, b = found.window, found.other
    count = a.sums.events + (b.sums.events if found.status == AMBIGUOUS else 0)
    few = a.sums.events < estimator.events_min
    if few or not _stands_out(count, column.events, half, estimator.rows):
        return Returns(TOO_FEW, False, a, b)
    return found


@kernel
def _find(column, half, estimator, seed):
    """Find a column's window; ``seed`` is a row to begin at, fixed point, or negative."""
    if seed >= 0:
        window = _mean_shift(column, seed, half, 0, ROW_LAST)
        events = window.sums.events
        # Otherwise a window elsewhere may hold more.
        if events >= estimator.events_min and 2 * events > column.events:
            return Returns(FOUND, False, window, window)
    return _search(column, half, estimator)


@kernel
def _all_returns(column, half, estimator, found):
    """Look for a second return beside the one that was found.

    Two equally strong ones are undecided only where the strongest is asked for.
    """
    if found.status == TOO_FEW:
        return found
    if found.status == AMBIGUOUS:
        return Returns(FOUND, True, found.window, found.other)
    return _second_return(column, half, estimator.rows, estimator.events_min, found.window)


@kernel
def _row(column, window, other, half, estimator, scratch):
    """Row of a return.

    ``other`` is the column's second return, or ``window`` itself when there is none.
    """
    method = estimator.method
    if method <= MEAN:
        return _mean(window)
    if method == MEDIAN:
        return _median_row(column, scratch.row_counts)
    if method == EDGE_MID:
        return _edge_midpoint(column, window.first, window.last, scratch.row_counts)
    first, last = np.int64(0), np.int64(ROW_LAST)
    if other.centre != window.centre:
        first, last = _side(window.centre, other.centre)
    return _gauss_ml(column, window, first, last, half, estimator.rows, scratch.likelihood)


@kernel
def _judge(row, variance, own, window, half, estimator):
    """Row, its own variance and whether the edge of the sensor cuts its window."""
    rows, noise = estimator.rows, estimator.noise
    if not _is_windowed(estimator.method):
        return _whole_sigma2(row, variance, own, window.sums.events, rows, noise)
    sigma2 = _sigma2(variance, own, window.sums.events, row, rows, noise)
    if window.first == 0 or window.last >= rows - 1.0:
        return _uncut_row(row, sigma2, variance, window, half, rows, noise)
    return Row(row, sigma2, False)


@kernel
def _chosen(returns, found):
    """Windows to report, nearest (least row) first; the same twice when it is one."""
    a, b = found.window, found.other
    if not found.second or returns == STRONGEST:
        return a, a
    near, far = (a, b) if a.centre < b.centre else (b, a)
    return (far, near) if returns == LAST else (near, far)


@kernel
def _estimate_columns(columns, half, estimator, out, scratch, counters):
    """Estimate every column's rows and empty the columns."""
    out.row[:] = np.nan
    squares = 0.0
    freedom = np.int64(0)
    neighbour = np.int64(-1)
    windowed = _is_windowed(estimator.method)
    own = min((half / HALF_PER_SIGMA) ** 2, estimator.line_variance)
    table = scratch.likelihood
    if estimator.method == GAUSS_ML:
        table = _fill_likelihood(table, half)
    scratch = Scratch(scratch.row_counts, table)
    for c in range(columns.counts.size):
        n = np.int64(columns.counts[c])
        columns.counts[c] = 0
        if n < estimator.events_min:
            if n > 0:
                counters.columns_too_few_events += 1
            continue
        column = _padded(columns.packed, columns.starts[c], n)
        last = columns.seeds[c]
        seed = np.int64(-1)
        if windowed and estimator.seeded:
            seed = last if last >= 0 else neighbour
        found = _find(column, half, estimator, seed)
        if estimator.returns != STRONGEST:
            found = _all_returns(column, half, estimator, found)
        out.ambiguous[c] = found.status == AMBIGUOUS
        if found.status != FOUND:
            if found.status == AMBIGUOUS:
                counters.columns_ambiguous += 1
            else:
                counters.columns_too_few_events += 1
            continue
        columns.seeds[c] = neighbour = found.window.centre
        counters.columns_two_returns += found.second
        window, other = _chosen(estimator.returns, found)
        for k in range(2 if found.second and estimator.returns == ALL else 1):
            variance = _variance(window.sums)
            row = _row(column, window, other, half, estimator, scratch)
            estimate = _judge(row, variance, own, window, half, estimator)
            if not windowed:
                columns.seeds[c] = np.int64(np.rint(FRACTION * row))
            common2 = _common2(columns.seeds[c], last, estimator.noise)
            # Until a profile has shown the line's width, nothing can be said to be missing.
            if not estimate.cut and half < estimator.half_max:
                common2 += _clipped2(variance, own, estimator.noise)
            used = window.sums.events
            out.row[k, c] = estimate.row
            out.sigma2[k, c] = estimate.sigma2
            out.common2[k, c] = common2
            out.variance[k, c] = variance
            out.events[k, c] = used
            out.mean_dt_us[k, c] = np.int64(np.rint(window.sums.time_us / used))
            out.cut[k, c] = estimate.cut
            narrow = variance <= _STRAYED * estimator.line_variance
            if not estimate.cut and (windowed or narrow):
                squares += variance * (used - 1)
                freedom += used - 1
            window, other = other, window
    return Spread(squares, freedom)
