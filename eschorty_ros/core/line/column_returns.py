"""The returns of a column: the windows of its events that are the line, on one surface or two."""

from __future__ import annotations

from typing import NamedTuple

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blinking import (
    _is_in_phase,
    _is_of_the_stream,
    _laser_test,
    _without,
    _without_hot_pixels,
)
from eschorty_ros.core.line.estimators import _LAST, _STRONGEST, _is_windowed
from eschorty_ros.core.line.window import (
    AMBIGUOUS,
    FOUND,
    TOO_FEW,
    UNMODULATED,
    Column,
    Returns,
    _densest_window,
    _exceeds_background,
    _full_column,
    _second_return,
)

# Windows of a column that are tested for the laser's modulation.
_WINDOWS_MAX = 16
# Weight of each of two neighbours' excess of events; 2 x 0.45 < 1, so that it sums to at most 10
# times a column's own.
_NEAR_WEIGHT = 0.45
# Share of its events that a line keeps where nothing hides it.
_UNCHANGED = 0.85
# Profiles at the same rows after which a second line may be the stronger one.
_SECOND_SEEN = 3


class _ColumnReturns(NamedTuple):
    """Returns of a column of the events that follow the laser; ``uncertain`` ones may not."""

    found: Returns
    column: Column
    uncertain: bool


@kernel(_nrt=False)
def _search(column, half, estimator):
    """Search a column for the window of its line."""
    if not _is_windowed(estimator.method):
        window = _full_column(column)
        status = FOUND if column.events >= estimator.events_min else TOO_FEW
        return Returns(status, False, window, window)
    found = _densest_window(column, half)
    events = found.window.sums.events
    line = events
    if found.status == AMBIGUOUS:
        line += found.other.sums.events
    others = column.events - line
    if events < estimator.events_min or not _exceeds_background(
        line, others, half, estimator.rows_taken
    ):
        return Returns(TOO_FEW, False, found.window, found.other)
    return found


@kernel(_nrt=False)
def _modulated(column, found, half, estimator, blink, row_counts):
    """Return the window of events that follow the laser, of the column without other windows.

    The status is ``UNMODULATED`` when no window of the column follows it.
    """
    events = column.events
    for _ in range(_WINDOWS_MAX):
        window = found.window
        test = _laser_test(column, window.first, window.last, blink)
        left = _without_hot_pixels(column, window.first, window.last, blink, row_counts)
        if left.events == column.events:
            # A second window is a second chance for background.
            if test.follows and (test.sure or column.events == events):
                uncertain = not test.sure or column.events < events
                return _ColumnReturns(found, column, uncertain)
            left = _without(column, window.first, window.last)
        column = left
        found = Returns(TOO_FEW, False, window, window)
        if column.events >= estimator.events_min:
            found = _search(column, half, estimator)
        if found.status == TOO_FEW:
            break
    found = Returns(UNMODULATED, False, found.window, found.window)
    return _ColumnReturns(found, column, True)


@kernel(_nrt=False)
def _all_returns(column, half, estimator, found):
    """Search for a second return beside the one that was found.

    Two equally strong ones are no ambiguity here, as both can be reported.
    """
    if found.status == TOO_FEW:
        return found
    if found.status == AMBIGUOUS:
        return Returns(FOUND, True, found.window, found.other)
    return _second_return(column, half, estimator.rows_taken, estimator.events_min, found.window)


@kernel
def _is_second(columns, c, window, half):
    """Return whether a window is where the column had its second line in the last profile."""
    return columns.second_rows[c] >= 0 and abs(window.centre - columns.second_rows[c]) <= half


@kernel
def _is_at(found, window, half):
    """Return whether a window is where the ``window`` around the column's last row is."""
    return abs(found.centre - window.centre) <= half


@kernel
def _stays(window, columns, c, estimator):
    """Return whether the ``window`` around a column's last row has most of that line's events."""
    least = max(_UNCHANGED * columns.events[c], float(estimator.events_min))
    return columns.events[c] > 0 and window.sums.events >= least


@kernel
def _is_new(columns, c, window, half):
    """Return whether a window has not been the second line of a column in the last profiles.

    A lamp, a screen or an edge that passes can have a burst in phase with the laser, but not in
    many profiles at the same rows.
    """
    return not _is_second(columns, c, window, half) or columns.second_seen[c] < _SECOND_SEEN


@kernel
def _set_second(columns, c, window, excess, half):
    """Set a column's second line, which has ``excess`` events less than the first one."""
    again = _is_second(columns, c, window, half)
    columns.second_seen[c] = columns.second_seen[c] + 1 if again else 1
    columns.second_rows[c], columns.excess[c] = window.centre, excess


@kernel(_nrt=False)
def _excess_nearby(columns, c, a, b, half):
    """Return by how many events neighbours have window ``a`` stronger than ``b``.

    They are the same column in the last period and the column before, where the windows continue
    their two lines.
    """
    excess = 0.0
    for other in (c, c - 1):
        if other < 0 or columns.second_rows[other] < 0:
            continue
        first, second = columns.seeds[other], columns.second_rows[other]
        if max(abs(a.centre - first), abs(b.centre - second)) <= half:
            excess += _NEAR_WEIGHT * columns.excess[other]
        elif max(abs(a.centre - second), abs(b.centre - first)) <= half:
            excess -= _NEAR_WEIGHT * columns.excess[other]
    return excess


@kernel(_nrt=False)
def _stronger(column, c, half, columns, estimator, blink, window, found):
    """Return the stronger one of a column's two returns; in a stream its neighbours count, too.

    A line that stays in the ``window`` around its last row is not left for one that is new.
    Boxes of dense events are full in the middle of every line; complete windows separate them.
    """
    both = _all_returns(column, half, estimator, found)
    a, b = both.window, both.other
    alone = not both.second
    if not alone and blink.step > 0:
        # A second window is a second chance for background.
        alone = not _laser_test(column, b.first, b.last, blink).sure
    if alone:
        columns.second_rows[c] = -1
        return Returns(FOUND, False, a, a)
    excess = float(a.sums.events - b.sums.events)
    if estimator.seeded:
        excess += _excess_nearby(columns, c, a, b, half)
    if excess < 0.0:
        a, b, excess = b, a, -excess
    stays = _stays(window, columns, c, estimator)
    if stays and _is_at(b, window, half) and _is_new(columns, c, a, half):
        a, b, excess = b, a, 0.0
    stays = stays and _is_at(a, window, half) and _is_new(columns, c, b, half)
    # Of two complete windows with as many events the one with the denser middle is the line.
    if excess == 0.0 and found.status == AMBIGUOUS and not stays:
        columns.second_rows[c] = -1
        return Returns(AMBIGUOUS, True, a, b)
    _set_second(columns, c, b, excess, half)
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
    """Return whether a window reaches the first or last row of the sensor."""
    return window.first == 0 or window.last >= sensor_rows - 1.0


@kernel
def _is_alone(used, events):
    """Return whether a window has more than two of three events: no other is nearly as strong."""
    return 3 * used > 2 * events


@kernel
def _is_clear(window, column, estimator, blink):
    """Return whether a window needs no search for others and no further test of its events."""
    events = window.sums.events
    return (
        events >= estimator.events_min
        and _is_alone(events, column.events)
        and not _is_cut(window, estimator.sensor_rows)
        and estimator.returns == _STRONGEST
        and (blink.step == 0 or _is_in_phase(window.sums, blink))
    )


@kernel(_nrt=False)
def _goes_on(window, found, columns, c, half, estimator):
    """Return whether a column's line is where it was, as strong, and another one is new there."""
    elsewhere = found.status == FOUND or not _is_at(found.other, window, half)
    return (
        found.status != TOO_FEW
        and estimator.returns == _STRONGEST
        and elsewhere
        and not _is_at(found.window, window, half)
        and _stays(window, columns, c, estimator)
        and _is_new(columns, c, found.window, half)
    )


@kernel(_nrt=False)
def _column_returns(column, c, half, columns, estimator, blink, window, row_counts):
    """Search a column for its returns; ``window`` is that around its last row, if it has one."""
    testing = _is_windowed(estimator.method) and blink.step > 0
    uncertain = False
    found = Returns(FOUND, False, window, window)
    if window.sums.events < estimator.events_min or 2 * window.sums.events <= column.events:
        found = _search(column, half, estimator)
        goes_on = testing and _goes_on(window, found, columns, c, half, estimator)
        if goes_on and _laser_test(column, window.first, window.last, blink).sure:
            new = found.window
            if _laser_test(column, new.first, new.last, blink).follows:
                _set_second(columns, c, new, 0.0, half)
            else:
                columns.second_rows[c] = -1
                column = _without(column, new.first, new.last)
            return _ColumnReturns(Returns(FOUND, False, window, window), column, False)
    in_phase = found.status == FOUND and _is_of_the_stream(column, found.window, blink)
    if testing and found.status != TOO_FEW and not in_phase:
        modulated = _modulated(column, found, half, estimator, blink, row_counts)
        found, column = modulated.found, modulated.column
        uncertain = modulated.uncertain
        if found.status == UNMODULATED:
            columns.second_rows[c] = -1
            return modulated
    if estimator.returns != _STRONGEST:
        found = _all_returns(column, half, estimator, found)
        if testing and found.second:
            other = found.other
            if not _laser_test(column, other.first, other.last, blink).follows:
                found = Returns(FOUND, False, found.window, found.window)
    elif _is_windowed(estimator.method):
        used = found.window.sums.events
        if found.status == AMBIGUOUS or (
            found.status == FOUND and not _is_alone(used, column.events)
        ):
            found = _stronger(column, c, half, columns, estimator, blink, window, found)
        else:
            columns.second_rows[c] = -1
    return _ColumnReturns(found, column, uncertain)
