"""Row of the laser line in every column, with its standard deviation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import integer, number
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blinking import (
    Blink,
    _is_in_phase,
    _laser_test,
    _without,
    _without_hot_pixels,
)
from eschorty_ros.core.line.columns import grouped_columns
from eschorty_ros.core.line.estimators import (
    HALF_MIN,
    HALF_PER_SIGMA,
    _mean,
    _median,
    _variance,
)
from eschorty_ros.core.line.learned import (
    LEARNED_ROWS,
    MEAN_ROWS,
    _learned_row,
    _sample,
    make_footprint,
)
from eschorty_ros.core.line.sigma import (
    SIGMA_FACTOR,
    SIGMA_FLOOR_PX,
    VARIANCE_PER_WIDTH2,
    ErrorModel,
    _own_variance,
    error_model,
)
from eschorty_ros.core.line.window import (
    AMBIGUOUS,
    FOUND,
    FRACTION,
    HALF_WIDTH_PER_FWHM,
    ROW_BITS,
    ROW_LAST,
    TOO_FEW,
    UNMODULATED,
    Returns,
    Sums,
    Window,
    _column,
    _densest_window,
    _exceeds_background,
    _full_column,
    _mean_shift,
    _pad,
    _second_return,
)

METHODS = ("mode_mean", "mean", "median")
CENTROIDS = (*METHODS, "learned")
"""The methods, and the one that follows a stream."""
FULL_COLUMN_METHODS = ("mean", "median")
RETURNS = ("strongest", "first", "last", "all")

# Codes are indices of the tuples above.
_MODE_MEAN, _MEAN, _MEDIAN, _LEARNED = range(4)
_STRONGEST, _FIRST, _LAST, _ALL = range(4)
# Windows of a column that are tested for the laser's modulation.
_WINDOWS_MAX = 4
# Weight of each of two neighbours' evidence; 2 x 0.45 < 1, so that it sums to at most 10 times a
# column's own.
_VOTE = 0.45
# A full column wider than this many times the line's variance holds background.
_BACKGROUND_FREE = 1.5
# Half the width of a line in standard deviations: 1.7 for a flat one, about 3 for a Gaussian.
_HALF_SPAN = 2.5
# Standard errors of a window's mean. A learned row further from it belongs to a line that has moved
# while it was lit, or that a rim cuts: the footprint does not describe it.
_LEARNED_OFF = 2.0
_NONE = np.int64(0)
_NO_WINDOW = Window(_NONE, _NONE, Sums(_NONE, _NONE, _NONE, _NONE, _NONE), np.int64(-1))
# Bias of the mean of half a Gaussian, squared, over the variance of that half.
_HALF_BIAS2 = 1.7519


@dataclass(frozen=True, slots=True)
class Centroids:
    """One entry per column, shape (columns,); NaN (and 0 events) where there is no row.

    With ``returns="all"`` the arrays but ``ambiguous`` have shape (columns, 2), nearest first.

    Attributes
    ----------
    row : float64
        Row of the line, px.
    sigma_row : float64
        Its standard deviation, px.
    width : float64
        Sample standard deviation of the rows used, px.
    events : int64
        Events used.
    ambiguous : bool
        Two separate, equally dense groups of events with ``returns="strongest"``: no row.
    edge : bool
        The first or last row of the sensor cuts the line, which ``sigma_row`` allows for.
    """

    row: NDArray[np.float64]
    sigma_row: NDArray[np.float64]
    width: NDArray[np.float64]
    events: NDArray[np.int64]
    ambiguous: NDArray[np.bool_]
    edge: NDArray[np.bool_]


class Estimator(NamedTuple):
    """Settings of an estimator.

    ``half_max`` is the half width of a window for the widest line, fixed point, and
    ``line_variance`` the variance of its rows. With ``seeded`` the search begins at the column's
    last row, or at its neighbour's.
    """

    method: int
    returns: int
    seeded: bool
    events_min: int
    sensor_rows: int
    half_max: int
    line_variance: float
    error_model: ErrorModel


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


class _ColumnReturns(NamedTuple):
    """Returns of a column and its events that follow the laser; ``uncertain`` ones may not."""

    found: Returns
    events: np.int64
    uncertain: bool


class PeriodSums(NamedTuple):
    """Pooled sum of squares of the rows used with its degrees of freedom, and counts of columns.

    ``events`` are those of the columns with a row, used or not.
    """

    squares: float
    freedom: np.int64
    events: np.int64
    too_few_events: np.int64
    ambiguous: np.int64
    two_returns: np.int64
    unmodulated: np.int64
    events_unmodulated: np.int64


def half_width_fixed(fwhm_px: float) -> int:
    """Return the half width of the averaging window for a line of ``fwhm_px``, fixed point."""
    return max(round(HALF_WIDTH_PER_FWHM * fwhm_px * FRACTION), HALF_MIN)


def check_method(method: str, returns: str = "strongest") -> tuple[int, int]:
    """Return the codes of a method and of the returns it reports.

    Raises
    ------
    ArgumentError
        When there is no such method or choice of returns, or the method does not separate returns.
    """
    if not isinstance(method, str) or method not in CENTROIDS:
        raise ArgumentError(f"centroid is {method!r}; choose one of {', '.join(CENTROIDS)}")
    if not isinstance(returns, str) or returns not in RETURNS:
        raise ArgumentError(f"returns is {returns!r}; choose one of {', '.join(RETURNS)}")
    if method in FULL_COLUMN_METHODS and returns != "strongest":
        windowed = [name for name in METHODS if name not in FULL_COLUMN_METHODS]
        raise ArgumentError(
            f"returns is {returns!r} and {method!r} averages the full column; choose 'strongest', "
            f"or one of {', '.join(windowed)} as centroid"
        )
    return CENTROIDS.index(method), RETURNS.index(returns)


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


def estimate(
    rows: ArrayLike,
    offsets: ArrayLike,
    method: str = "mode_mean",
    *,
    returns: str = "strongest",
    line_width_px: float = 20.0,
    height: int = 720,
    events_min: int = 1,
    sigma_factor: float = SIGMA_FACTOR,
    sigma_floor_px: float = SIGMA_FLOOR_PX,
) -> Centroids:
    """Return the row of the line in each column, independently of the others.

    Parameters
    ----------
    rows : array of integer, shape (N,)
        Rows of the events, 0 to ``height`` - 1, grouped by column in any order.
    offsets : array of int64, shape (columns + 1,)
        Column ``c`` has the events ``rows[offsets[c]:offsets[c + 1]]``.
    method : {"mode_mean", "mean", "median"}
        ``mode_mean`` averages the densest window (half width 1.3 x ``line_width_px``, at most 5
        mean-shift steps) and ignores background elsewhere. ``mean`` and ``median`` use the full
        column (``mean`` is the method of the paper).
    returns : {"strongest", "first", "last", "all"}
        Returns to report where a column has a second one: another window at least
        2 x ``line_width_px`` away whose inner half has at least half as many events, and more than
        background explains. ``first`` is the one at the least row, hence the nearest.
    line_width_px : float
        Full width of the line at half maximum, rows.
    height : int
        Rows of the sensor, at most 1023.
    events_min : int
        Columns with fewer events in the window give NaN.
    sigma_factor, sigma_floor_px : float
        Error model of ``sigma_row``, see `sigma`.

    Returns
    -------
    Centroids

    Raises
    ------
    ArgumentError
        When rows, offsets or a parameter are not as described above.

    Notes
    -----
    Every method is exactly symmetric under mirroring and shifting of the rows and does not depend
    on their order. Of equally dense windows the one that ends with more events is used, then the
    narrower one; overlapping ones are merged; of two separate equal ones the strongest is NaN,
    since any choice would prefer a direction, while the other ``returns`` report them both.

    Where the sensor's edge cuts the line ``sigma_row`` covers the bias of the part that is left. A
    stream corrects it, with the footprint of the line elsewhere.

    Examples
    --------
    Two columns; the second has a background event at row 40, far from its line.

    >>> found = estimate([300, 301, 302, 299, 300, 301, 40], [0, 3, 7])
    >>> found.row
    array([301., 300.])
    >>> found.events
    array([3, 3])
    """
    row_array = _checked_rows(rows, height)
    offset_array = _checked_offsets(offsets, row_array.size)
    if not 0.5 <= number("line_width_px", line_width_px) <= height:
        raise ArgumentError(f"line_width_px is {line_width_px!r}; choose 0.5 to {height}")
    integer("events_min", events_min, 1, 1 << 31)
    method_code, returns_code = check_method(method, returns)
    if method == "learned":
        raise ArgumentError("centroid 'learned' follows a stream; choose another for columns alone")
    estimator = Estimator(
        method=method_code,
        returns=returns_code,
        seeded=False,
        events_min=events_min,
        sensor_rows=height,
        half_max=half_width_fixed(line_width_px),
        line_variance=VARIANCE_PER_WIDTH2 * float(line_width_px) ** 2,
        error_model=error_model(method, sigma_factor, sigma_floor_px),
    )
    found = empty_rows(2 if returns == "all" else 1, offset_array.size - 1)
    columns, row_counts = grouped_columns(row_array, offset_array), make_row_counts()
    footprint = make_footprint(estimator.half_max, columns=0)
    _estimate_columns(columns, estimator.half_max, estimator, Blink(), footprint, found, row_counts)
    by_column = slice(None) if returns == "all" else 0
    row, sigma, width, events, truncated = (
        np.ascontiguousarray(values.T[:, by_column])
        for values in (
            found.row,
            np.sqrt(found.sigma2 + found.common2),
            np.sqrt(found.variance),
            found.events,
            found.truncated,
        )
    )
    return Centroids(row, sigma, width, events, found.ambiguous, truncated)


def _checked_rows(rows: ArrayLike, height: int) -> NDArray[np.uint32]:
    integer("height", height, 1, ROW_LAST + 1)
    array = np.asarray(rows)
    if array.ndim != 1 or (array.size and not np.issubdtype(array.dtype, np.integer)):
        raise ArgumentError(
            f"rows has shape {array.shape} and dtype {array.dtype}; give one axis of integers"
        )
    if array.size and not (array.min() >= 0 and array.max() < height):
        raise ArgumentError(
            f"rows span {array.min()} to {array.max()}; the sensor has rows 0 to {height - 1}"
        )
    return array.astype(np.uint32)


def _checked_offsets(offsets: ArrayLike, size: int) -> NDArray[np.int64]:
    array = np.asarray(offsets)
    if array.ndim != 1 or array.size < 1 or not np.issubdtype(array.dtype, np.integer):
        raise ArgumentError(
            f"offsets has shape {array.shape} and dtype {array.dtype}; give one axis of integers"
        )
    wide = array.astype(np.int64)
    if wide[0] != 0 or wide[-1] != size or (np.diff(wide) < 0).any():
        raise ArgumentError(
            f"offsets run from {wide[0]} to {wide[-1]} for {size} rows; "
            "start at 0, never fall, end at the number of rows"
        )
    return wide


@kernel
def _is_windowed(method):
    return method != _MEAN and method != _MEDIAN


@kernel(_nrt=False)
def _search(packed, column, half, estimator):
    """Search a column for the window of its line."""
    if not _is_windowed(estimator.method):
        window = _full_column(packed, column)
        status = FOUND if column.events >= estimator.events_min else TOO_FEW
        return Returns(status, False, window, window)
    found = _densest_window(packed, column, half)
    events = found.window.sums.events
    line = events
    if found.status == AMBIGUOUS:
        line += found.other.sums.events
    others = column.events - line
    if events < estimator.events_min or not _exceeds_background(
        line, others, half, estimator.sensor_rows
    ):
        return Returns(TOO_FEW, False, found.window, found.other)
    return found


@kernel(_nrt=False)
def _modulated(packed, column, found, half, estimator, blink, row_counts):
    """Return the window of events that follow the laser, and the column without other windows.

    The last value is true when the window may be background all the same. The status is
    ``UNMODULATED`` when no window of the column follows it.
    """
    events = column.events
    for _ in range(_WINDOWS_MAX):
        window = found.window
        test = _laser_test(packed, column, window.first, window.last, blink)
        left = _without_hot_pixels(packed, column, window.first, window.last, blink, row_counts)
        if left.events == column.events:
            # A second window is a second chance for background.
            if test.follows and (test.sure or column.events == events):
                return found, column, not test.sure or column.events < events
            left = _without(packed, column, window.first, window.last)
        column = left
        found = Returns(TOO_FEW, False, window, window)
        if column.events >= estimator.events_min:
            found = _search(packed, column, half, estimator)
        if found.status == TOO_FEW:
            break
    return Returns(UNMODULATED, False, found.window, found.window), column, True


@kernel(_nrt=False)
def _all_returns(packed, column, half, estimator, found):
    """Search for a second return beside the one that was found.

    Two equally strong ones are no ambiguity here, as both can be reported.
    """
    if found.status == TOO_FEW:
        return found
    if found.status == AMBIGUOUS:
        return Returns(FOUND, True, found.window, found.other)
    return _second_return(
        packed, column, half, estimator.sensor_rows, estimator.events_min, found.window
    )


@kernel(_nrt=False)
def _vote(columns, c, a, b, half):
    """Return by how many events neighbours have window ``a`` stronger than its rival ``b``.

    They are the same column in the last period and the column before, where the windows continue
    their two lines.
    """
    evidence = 0.0
    for other in (c, c - 1):
        if other < 0 or columns.rivals[other] < 0:
            continue
        first, second = columns.seeds[other], columns.rivals[other]
        if max(abs(a.centre - first), abs(b.centre - second)) <= half:
            evidence += _VOTE * columns.evidence[other]
        elif max(abs(a.centre - second), abs(b.centre - first)) <= half:
            evidence -= _VOTE * columns.evidence[other]
    return evidence


@kernel(_nrt=False)
def _stronger(packed, column, c, half, columns, estimator, blink, found):
    """Return the stronger one of a column's two returns; in a stream its neighbours vote.

    Boxes of dense events are full in the middle of every line; complete windows tell them apart.
    """
    both = _all_returns(packed, column, half, estimator, found)
    a, b = both.window, both.other
    alone = not both.second
    if not alone and blink.step > 0:
        # A second window is a second chance for background.
        alone = not _laser_test(packed, column, b.first, b.last, blink).sure
    if alone:
        columns.rivals[c] = -1
        return Returns(FOUND, False, a, a)
    evidence = float(a.sums.events - b.sums.events)
    if estimator.seeded:
        evidence += _vote(columns, c, a, b, half)
    columns.rivals[c] = -1
    # Of two complete windows with as many events the one with the denser middle is the line.
    if evidence == 0.0 and found.status == AMBIGUOUS:
        return Returns(AMBIGUOUS, True, a, b)
    if evidence < 0.0:
        a, b = b, a
    columns.rivals[c] = b.centre
    columns.evidence[c] = abs(evidence)
    return Returns(FOUND, False, a, a)


@kernel
def _reported(returns, found):
    """Return the windows to report, nearest (least row) first; the same twice when it is one."""
    a, b = found.window, found.other
    if not found.second or returns == _STRONGEST:
        return a, a
    near, far = (a, b) if a.centre < b.centre else (b, a)
    return (far, near) if returns == _LAST else (near, far)


@kernel
def _is_cut(window, sensor_rows):
    """Return true when a window reaches the first or last row of the sensor."""
    return window.first == 0 or window.last >= sensor_rows - 1.0


@kernel
def _is_alone(used, events):
    """Return true when a window has so many of the events that no other is nearly as strong."""
    return 3 * used > 2 * events


@kernel
def _is_clear(window, column, estimator, blink):
    """Return true when a window needs no search for others and no further test of its events."""
    events = window.sums.events
    return (
        events >= estimator.events_min
        and _is_alone(events, column.events)
        and not _is_cut(window, estimator.sensor_rows)
        and estimator.returns == _STRONGEST
        and (blink.step == 0 or _is_in_phase(window.sums))
    )


@kernel(_nrt=False)
def _column_returns(packed, column, c, half, columns, estimator, blink, window, row_counts):
    """Search a column for its returns; ``window`` is that around its last row, if it has one."""
    testing = _is_windowed(estimator.method) and blink.step > 0
    uncertain = False
    found = Returns(FOUND, False, window, window)
    if window.sums.events < estimator.events_min or 2 * window.sums.events <= column.events:
        found = _search(packed, column, half, estimator)
    if testing and not (
        found.status == TOO_FEW or (found.status == FOUND and _is_in_phase(found.window.sums))
    ):
        found, column, uncertain = _modulated(
            packed, column, found, half, estimator, blink, row_counts
        )
        if found.status == UNMODULATED:
            return _ColumnReturns(found, column.events, True)
    if estimator.returns != _STRONGEST:
        found = _all_returns(packed, column, half, estimator, found)
        if testing and found.second:
            other = found.other
            if not _laser_test(packed, column, other.first, other.last, blink).follows:
                found = Returns(FOUND, False, found.window, found.window)
    elif _is_windowed(estimator.method):
        used = found.window.sums.events
        if found.status == AMBIGUOUS or (
            found.status == FOUND and not _is_alone(used, column.events)
        ):
            found = _stronger(packed, column, c, half, columns, estimator, blink, found)
        else:
            columns.rivals[c] = -1
    return _ColumnReturns(found, column.events, uncertain)


@kernel
def _learns(footprint):
    """Return true when the line's footprint is learned from the profile."""
    return footprint.state.near_edge > 0 or footprint.state.choice != MEAN_ROWS


@kernel(_nrt=False, forceinline=True)
def _refine(packed, column, at, window, line_variance, estimator, footprint, row_counts, windows):
    """Set the row of a window's line that a learned footprint or the median gives.

    ``at`` is the place of the return: its number and its column.
    """
    c = at[1]
    sensor_rows, method = estimator.sensor_rows, estimator.method
    events, d = window.sums.events, window.sums.d
    row, variance = _mean(events, window.first, d), _variance(events, d, window.sums.d2)
    cut = _is_windowed(method) and _is_cut(window, sensor_rows)
    best, learned = row, -1.0
    takes, trying = footprint.state.choice == LEARNED_ROWS, footprint.state.trying > 0
    if _learns(footprint):
        _sample(packed, column, c, row, sensor_rows, footprint, row_counts)
    if cut or trying or takes:
        best, learned = _learned_row(packed, column, row, sensor_rows, footprint, row_counts)
    if method == _MEDIAN:
        windows.row[at] = _median(packed, column, row_counts)
    near = events * (best - row) ** 2 <= _LEARNED_OFF**2 * line_variance
    if trying and near and not cut:
        footprint.trial[c] = best - row
    if learned >= 0.0 and (cut or (near and takes)):
        windows.row[at] = min(max(best, -0.5), sensor_rows - 0.5)
        windows.sigma2[at] = learned
        bias = 0.0
        if footprint.state.cut_computations > 0:
            # No whole line has been seen. The part that is left is off by so much, less what the
            # footprint of cut lines explains.
            bias = max(np.sqrt(_HALF_BIAS2 * variance) - abs(best - row), 0.0)
        windows.common2[at] = bias * bias


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
        # Background widens a column without moving the line to the edge.
        line = min(variance[c], _BACKGROUND_FREE * line_variance)
        common2[c] = (
            line if min(row[c], sensor_rows - 1.0 - row[c]) < _HALF_SPAN * np.sqrt(line) else 0.0
        )
    for c in range(np.uintp(row.size)):
        truncated[c] = common2[c] > 0.0
        common2[c] *= _HALF_BIAS2


@kernel(_nrt=False)
def _replace(new, values):
    """Replace values by new ones where there are any, and forget these."""
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
def _pooled(out, estimator):
    """Return the pooled squares of the rows used, their degrees of freedom and the events.

    Lines that are cut, and full columns with background, do not have the width of a line.
    """
    squares, freedom, events = 0.0, np.int64(0), np.int64(0)
    most = _BACKGROUND_FREE * estimator.line_variance
    windowed = _is_windowed(estimator.method)
    for k in range(out.row.shape[0]):
        for c in range(np.uintp(out.row.shape[1])):
            whole = out.events[k, c] > 0 and not out.truncated[k, c]
            if whole and (windowed or out.variance[k, c] <= most):
                used = out.events[k, c] - 1
                squares += out.variance[k, c] * used
                freedom += used
                events += out.windows.column_events[k, c] if k == 0 else 0
    return squares, freedom, events


@kernel(_nrt=False)
def _estimate_columns(columns, half, estimator, blink, footprint, out, row_counts):
    """Estimate the rows of every column into ``out`` and empty the columns.

    Events that do not follow the laser are left out, unless ``blink`` is no test.
    """
    out.events[:] = 0
    few, ambiguous, two = np.int64(0), np.int64(0), np.int64(0)
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
        _pad(packed, columns.starts[c] + np.int64(columns.counts[c, 0]))
    for c in range(columns.seeds.size):
        n = np.int64(columns.counts[c, 0])
        columns.counts[c, 0] = 0
        out.ambiguous[c] = False
        if n < estimator.events_min:
            few += n > 0
            continue
        column = _column(columns.starts[c], n, blink.lit_us)
        known = columns.seeds[c] >= 0
        if not known:
            # Stored rather than selected: a select would chain each column to the one before.
            columns.seeds[c] = neighbour
        window = _NO_WINDOW
        if windowed and estimator.seeded and columns.seeds[c] >= 0:
            window = _mean_shift(packed, column, columns.seeds[c], half, 0, ROW_LAST)
            if _is_clear(window, column, estimator, blink):
                columns.rivals[c] = -1
                columns.seeds[c] = neighbour = window.centre
                _put((0, c), window, n, False, out)
                if not plain:
                    _refine(
                        packed, column, (0, c), window, line_variance, estimator, footprint,
                        row_counts, out.windows,
                    )  # fmt: skip
                continue
        searched = _column_returns(
            packed, column, c, half, columns, estimator, blink, window, row_counts
        )
        found = searched.found
        if found.status == UNMODULATED:
            unmodulated += 1
        events_unmodulated += n - searched.events
        if found.status != FOUND:
            out.ambiguous[c] = found.status == AMBIGUOUS
            ambiguous += found.status == AMBIGUOUS
            few += found.status == TOO_FEW
            if not known:
                columns.seeds[c] = -1
            continue
        columns.seeds[c] = neighbour = found.window.centre
        two += found.second
        window, other = _reported(estimator.returns, found)
        left = _column(columns.starts[c], searched.events, blink.lit_us)
        for k in range(2 if found.second and estimator.returns == _ALL else 1):
            _put((k, c), window, n, searched.uncertain, out)
            _refine(
                packed, left, (k, c), window, line_variance, estimator, footprint, row_counts,
                out.windows,
            )  # fmt: skip
            refined = True
            near_edge |= windowed and _is_cut(window, estimator.sensor_rows)
            window, other = other, window
    footprint.state.near_edge = near_edge
    _rows_of_windows(out, line_variance, estimator, refined)
    squares, freedom, events = _pooled(out, estimator)
    return PeriodSums(
        squares, freedom, events, few, ambiguous, two, unmodulated, events_unmodulated
    )
