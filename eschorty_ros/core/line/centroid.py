"""Row of the laser line in every column, with its standard deviation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.column_returns import _column_returns, _is_clear, _is_cut, _reported
from eschorty_ros.core.line.estimators import (
    _ALL,
    _MEDIAN,
    _MODE_MEAN,
    HALF_PER_SIGMA,
    _is_windowed,
    _mean,
    _median,
    _variance,
)
from eschorty_ros.core.line.learned import (
    LEARNED_ROWS,
    MEAN_ROWS,
    _centre_error_px,
    _learned_row,
    _sample,
)
from eschorty_ros.core.line.sigma import _own_variance
from eschorty_ros.core.line.window import (
    AMBIGUOUS,
    FOUND,
    FRACTION,
    ROW_BITS,
    ROW_LAST,
    ROW_MASK,
    TOO_FEW,
    UNMODULATED,
    Sums,
    Window,
    _column,
    _exceeds_background,
    _mean_shift,
    _pad,
)

# A full column wider than this many times the line's variance holds background.
_BACKGROUND_FREE = 1.5
# Half the width of a line in standard deviations: 1.7 for a flat one, about 3 for a Gaussian.
_HALF_SPAN = 2.5
# Standard errors of a window's mean. A learned row further from it belongs to a line that has moved
# while it was lit, or that a rim cuts: the footprint does not describe it.
_LEARNED_OFF = 2.0
_NONE = np.int64(0)
_NO_WINDOW = Window(_NONE, _NONE, Sums(_NONE, _NONE, _NONE, _NONE, _NONE), np.int64(-1))
# Widths that are separated for their median, per row.
_WIDTHS_PER_ROW = 16
# Bias of the mean of half a Gaussian, squared, over the variance of that half.
_HALF_BIAS2 = 1.7519


class Windows(NamedTuple):
    """Sums over the window of each return, shape (returns, columns), and what replaces its mean.

    Rows are relative to the ``first`` one of the window. ``column_events`` are in the window or
    not. ``row`` replaces the mean, and ``sigma2`` and ``common2`` the variances where they are
    known; NaN where nothing does.
    """

    first: NDArray[np.int64]
    d: NDArray[np.int64]
    d2: NDArray[np.int64]
    time_us: NDArray[np.int64]
    column_events: NDArray[np.int64]
    row: NDArray[np.float64]
    sigma2: NDArray[np.float64]
    common2: NDArray[np.float64]


class Rows(NamedTuple):
    """The returns of each column, shape (returns, columns), NaN where there is none.

    The variance of a row is ``sigma2``, which is the column's own, plus ``common2``, which
    neighbours share. ``variance`` is that of the rows of its ``events``, ``mean_dt_us`` their mean
    time since the period's edge. The sensor's edge cuts the line of a ``truncated`` row, an
    ``uncertain`` one may be background that follows the laser by chance, a ``mixed`` one is on two
    surfaces. ``ambiguous`` has shape (columns,).
    """

    windows: Windows
    row: NDArray[np.float64]
    sigma2: NDArray[np.float64]
    common2: NDArray[np.float64]
    variance: NDArray[np.float64]
    events: NDArray[np.int64]
    mean_dt_us: NDArray[np.int64]
    truncated: NDArray[np.bool_]
    uncertain: NDArray[np.bool_]
    mixed: NDArray[np.bool_]
    ambiguous: NDArray[np.bool_]


class LineSums(NamedTuple):
    """Median width of the lines (standard deviation of the rows used), with degrees of freedom.

    ``events`` are those of the columns with a row, used or not; there are so many ``lines``.
    """

    width: float
    freedom: np.int64
    events: np.int64
    lines: np.int64


class PeriodSums(NamedTuple):
    """Sums over the line of a period, and counts of columns.

    Those with ``too_few_events`` are ``weak`` where two events are at the line's row, or three if
    they have as many as a point needs, in all rows.
    """

    line: LineSums
    too_few_events: np.int64
    weak: np.int64
    ambiguous: np.int64
    two_returns: np.int64
    unmodulated: np.int64
    events_unmodulated: np.int64


def make_row_counts() -> NDArray[np.int64]:
    """Return zeroed counts, one per row."""
    return np.zeros(1 << ROW_BITS, np.int64)


def empty_rows(returns: int, columns: int) -> Rows:
    """Return the rows of ``columns`` columns without any return."""
    shape = returns, columns
    windows = Windows(*np.zeros((5, *shape), np.int64), *np.full((3, *shape), np.nan))
    row, sigma2, common2, variance = np.full((4, *shape), np.nan)
    events, mean_dt_us = np.zeros((2, *shape), np.int64)
    truncated, uncertain, mixed = np.zeros((3, *shape), np.bool_)
    flags = truncated, uncertain, mixed, np.zeros(columns, np.bool_)
    return Rows(windows, row, sigma2, common2, variance, events, mean_dt_us, *flags)


@kernel(_nrt=False, forceinline=True)
def _cut_bias2(row, variance, line_variance, sensor_rows):
    """Return the squared bias of a row if half of its line is on the sensor, and whether less is.

    Then the centre is beyond the sensor, and the bias that of a line of ``line_variance``.
    """
    from_edge = min(row, sensor_rows - 1.0 - row) + 0.5
    # Rows lit evenly from the edge on are 1.7 deviations from it; half of them vary by a fourth.
    less = from_edge * from_edge < 4.0 * variance < line_variance
    return _HALF_BIAS2 * (line_variance if less else variance), less


@kernel
def _learns(footprint):
    """Return whether the line's footprint is learned from the profile."""
    return footprint.state.near_edge > 0 or footprint.state.choice != MEAN_ROWS


@kernel(_nrt=False, forceinline=True)
def _refine(column, at, window, line_variance, estimator, footprint, row_counts, windows):
    """Set the row of a window's line where a learned footprint or the method gives another one.

    ``at`` is the place of the return: its number and its column.
    """
    c = at[1]
    sensor_rows, method = estimator.sensor_rows, estimator.method
    events, d = window.sums.events, window.sums.d
    row, variance = _mean(events, window.first, d), _variance(events, d, window.sums.d2)
    cut = _is_windowed(method) and _is_cut(window, sensor_rows)
    best, learned = row, -1.0
    takes, trying = footprint.state.choice == LEARNED_ROWS, footprint.state.trying > 0
    if _learns(footprint) and at[0] == 0:
        _sample(column, c, row, sensor_rows, footprint, row_counts)
    if cut or trying or takes:
        best, learned = _learned_row(column, row, sensor_rows, footprint, row_counts)
    if method == _MEDIAN:
        windows.row[at] = _median(column, row_counts)
    near = events * (best - row) ** 2 <= _LEARNED_OFF**2 * line_variance
    if trying and near and not cut and at[0] == 0:
        footprint.trial[c] = best - row
    if learned >= 0.0 and (cut or (near and takes)):
        reported = min(max(best, -0.5), sensor_rows - 0.5)
        windows.row[at] = reported
        windows.sigma2[at] = learned
        bias = 0.0
        bias2, less = _cut_bias2(row, variance, line_variance, sensor_rows)
        if less or footprint.state.all_cut > 0:
            # The footprint has no whole line, or no rows beyond the sensor. The part that is left
            # is off by so much, less what the footprint explains.
            bias = max(np.sqrt(bias2) - abs(reported - row), 0.0)
            bias = bias if less else min(bias, _centre_error_px(footprint))
        windows.common2[at] = bias * bias + (best - reported) ** 2


@kernel(_nrt=False, forceinline=True)
def _put(at, window, column_events, uncertain, out):
    """Write the sums of a return of a column."""
    windows, sums = out.windows, window.sums
    out.events[at] = sums.events
    out.uncertain[at] = uncertain
    windows.first[at] = window.first
    windows.d[at] = sums.d
    windows.d2[at] = sums.d2
    windows.time_us[at] = sums.time_us
    windows.column_events[at] = column_events


@kernel(_nrt=False)
def _mean_rows(first, d, events, row):
    """Set the mean rows of windows."""
    for c in range(np.uintp(row.size)):
        row[c] = _mean(events[c], first[c], d[c])


@kernel(_nrt=False)
def _variances(d, d2, events, variance):
    """Set the sample variances of windows."""
    for c in range(np.uintp(variance.size)):
        variance[c] = _variance(events[c], d[c], d2[c])


@kernel(_nrt=False)
def _mean_times(time_us, events, mean_dt_us):
    """Set the mean times of windows, us."""
    for c in range(np.uintp(mean_dt_us.size)):
        mean_dt_us[c] = np.int64(np.rint(time_us[c] / max(events[c], 1)))


@kernel(_nrt=False)
def _own_variances(variance, row, events, line_variance, estimator, sigma2):
    """Set the variances of rows that are the columns' own."""
    sensor_rows, model = estimator.sensor_rows, estimator.error_model
    for c in range(np.uintp(row.size)):
        n = max(events[c], 1)
        sigma2[c] = _own_variance(variance[c], line_variance, n, row[c], sensor_rows, model)


@kernel(_nrt=False)
def _cut_lines(variance, row, line_variance, sensor_rows, truncated, common2):
    """Mark lines that the sensor's edge cuts; their shared variance covers the bias."""
    for c in range(np.uintp(row.size)):
        # Background widens a column without moving the line to the edge. Of a line beyond the edge
        # one row may be left.
        line = max(min(variance[c], _BACKGROUND_FREE * line_variance), 1.0 / 12.0)
        bias2, _ = _cut_bias2(row[c], line, line_variance, sensor_rows)
        common2[c] = (
            bias2 if min(row[c], sensor_rows - 1.0 - row[c]) < _HALF_SPAN * np.sqrt(line) else 0.0
        )
    for c in range(np.uintp(row.size)):
        truncated[c] = common2[c] > 0.0


@kernel(_nrt=False)
def _replace(new, values):
    """Replace values by new ones where there are any, and clear these."""
    for c in range(np.uintp(values.size)):
        values[c] = values[c] if np.isnan(new[c]) else new[c]
        new[c] = np.nan


@kernel(_nrt=False)
def _rows_of_windows(out, line_variance, estimator, refined):
    """Turn the sums of all windows into rows with their variances.

    Loops over all columns, each over a few arrays, run in vectors.
    """
    windows, is_median = out.windows, estimator.method == _MEDIAN
    for k in range(out.row.shape[0]):
        events, row, variance, sigma2 = out.events[k], out.row[k], out.variance[k], out.sigma2[k]
        _mean_rows(windows.first[k], windows.d[k], events, row)
        _variances(windows.d[k], windows.d2[k], events, variance)
        _mean_times(windows.time_us[k], events, out.mean_dt_us[k])
        if is_median:
            _replace(windows.row[k], row)
        _own_variances(variance, row, events, line_variance, estimator, sigma2)
        _cut_lines(
            variance, row, line_variance, estimator.sensor_rows, out.truncated[k], out.common2[k]
        )
        if refined and not is_median:
            _replace(windows.row[k], row)
            _replace(windows.sigma2[k], sigma2)
            _replace(windows.common2[k], out.common2[k])


@kernel(_nrt=False)
def _pooled(out, estimator, counts):
    """Return the sums over the rows used; ``counts`` is zeroed scratch.

    Lines that are cut, and full columns with background, do not have the width of a line. The
    median leaves out two surfaces in one window, which would keep the windows of all so wide.
    """
    freedom, events, lines = np.int64(0), np.int64(0), np.int64(0)
    most = _BACKGROUND_FREE * estimator.line_variance
    windowed = _is_windowed(estimator.method)
    for k in range(out.row.shape[0]):
        for c in range(np.uintp(out.row.shape[1])):
            whole = out.events[k, c] > 0 and not out.truncated[k, c]
            if whole and (windowed or out.variance[k, c] <= most):
                used = out.events[k, c] - 1
                width = np.int64(_WIDTHS_PER_ROW * np.sqrt(out.variance[k, c]))
                counts[min(width, counts.size - 1)] += used
                freedom += used
                events += out.windows.column_events[k, c] if k == 0 else 0
                lines += k == 0
    below, place = np.int64(0), 0
    while 2 * (below + counts[place]) < freedom:
        below += counts[place]
        place += 1
    within = (0.5 * freedom - below) / max(counts[place], 1)
    counts[:] = 0
    return LineSums((place + within) / _WIDTHS_PER_ROW, freedom, events, lines)


@kernel
def _are_two_near(packed, start, events, centre, half):
    """Return whether two of a column's few events are within ``half`` of ``centre``.

    One may be background.
    """
    near = 0
    for i in range(start, start + events):
        near += abs(np.int64(packed[i] & ROW_MASK) * FRACTION - centre) <= half
    return near >= 2


@kernel
def _is_weak(window, column_events, half, estimator):
    """Return whether a window has more events than background, but fewer than a point has.

    Two may be background.
    """
    events = window.sums.events
    return 2 < events < estimator.events_min and _exceeds_background(
        events, column_events - events, half, estimator.rows_taken
    )


@kernel(_nrt=False)
def _estimate_columns(columns, half, estimator, blink, footprint, out, row_counts):
    """Estimate the rows of every column into ``out``.

    Events that do not follow the laser are left out, unless ``blink`` is no test.
    """
    out.events[:] = 0
    few, weak, ambiguous, two = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    unmodulated, events_unmodulated = np.int64(0), np.int64(0)
    neighbour = np.int64(-1)
    windowed = _is_windowed(estimator.method)
    plain = estimator.method == _MODE_MEAN and not _learns(footprint)
    near_edge, refined = False, not plain
    packed = columns.packed
    line_variance = (half / HALF_PER_SIGMA) ** 2
    if half <= estimator.half_max:
        line_variance = min(line_variance, estimator.line_variance)
    for c in range(columns.seeds.size):
        _pad(packed, columns.starts[c] + np.int64(columns.counts[c]))
    for c in range(columns.seeds.size):
        n = np.int64(columns.counts[c])
        out.ambiguous[c] = False
        if n < estimator.events_min:
            few += n > 0
            seed = columns.seeds[c] if columns.seeds[c] >= 0 else neighbour
            weak += seed >= 0 and _are_two_near(packed, columns.starts[c], n, seed, half)
            columns.second_rows[c], columns.events[c] = -1, 0
            continue
        column = _column(packed, columns.starts[c], n, blink.lit_us)
        known = columns.seeds[c] >= 0
        if not known:
            # Stored rather than selected: a select would chain each column to the one before.
            columns.seeds[c] = neighbour
        window = _NO_WINDOW
        if windowed and estimator.seeded and columns.seeds[c] >= 0:
            window = _mean_shift(column, columns.seeds[c], half, 0, ROW_LAST)
            if _is_clear(window, column, estimator, blink):
                columns.second_rows[c] = -1
                columns.seeds[c] = neighbour = window.centre
                columns.events[c] = window.sums.events
                _put((0, c), window, n, False, out)
                if not plain:
                    _refine(
                        column, (0, c), window, line_variance, estimator, footprint,
                        row_counts, out.windows,
                    )  # fmt: skip
                continue
        searched = _column_returns(column, c, half, columns, estimator, blink, window, row_counts)
        found = searched.found
        if found.status == UNMODULATED:
            unmodulated += 1
        events_unmodulated += n - searched.column.events
        if found.status != FOUND:
            out.ambiguous[c] = found.status == AMBIGUOUS
            ambiguous += found.status == AMBIGUOUS
            few += found.status == TOO_FEW
            weak += found.status == TOO_FEW and known and _is_weak(window, n, half, estimator)
            columns.events[c] = 0
            if not known:
                columns.seeds[c] = -1
            continue
        columns.seeds[c] = neighbour = found.window.centre
        columns.events[c] = found.window.sums.events
        two += found.second
        window, other = _reported(estimator.returns, found)
        for k in range(2 if found.second and estimator.returns == _ALL else 1):
            _put((k, c), window, n, searched.uncertain, out)
            _refine(
                searched.column, (k, c), window, line_variance, estimator, footprint, row_counts,
                out.windows,
            )  # fmt: skip
            refined = True
            near_edge |= windowed and _is_cut(window, estimator.sensor_rows)
            window, other = other, window
    footprint.state.near_edge = near_edge
    _rows_of_windows(out, line_variance, estimator, refined)
    line = _pooled(out, estimator, row_counts)
    return PeriodSums(line, few, weak, ambiguous, two, unmodulated, events_unmodulated)
