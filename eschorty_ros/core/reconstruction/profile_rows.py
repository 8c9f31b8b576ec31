"""Turn a period's events, sorted into columns, into the rows of a profile."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.line.blinking import Blink, _add_lines, _clear_lines, recent_lines
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS
from eschorty_ros.core.line.burst_shift import (
    Bursts,
    _clear_bursts,
    _compare_bursts,
    _points_followed,
    _use_late_rows,
    empty_bursts,
)
from eschorty_ros.core.line.centroid import (
    Rows,
    _estimate_columns,
    _learns,
    empty_rows,
    make_row_counts,
)
from eschorty_ros.core.line.columns import Columns, empty_columns
from eschorty_ros.core.line.delay import Light, _delay_us
from eschorty_ros.core.line.estimators import (
    _LEARNED,
    HALF_MIN,
    HALF_PER_SIGMA,
    Estimator,
    _is_windowed,
    check_method,
    half_width_fixed,
)
from eschorty_ros.core.line.learned import (
    LEARNED_ROWS,
    MEAN_ROWS,
    UNDECIDED,
    Footprint,
    _choose,
    _learn,
    _restart_from,
    make_footprint,
)
from eschorty_ros.core.line.learned_gate import (
    LearnedGate,
    _keep_gate,
    _learn_gate,
    _restart_gate,
    _use_late,
    make_gate,
)
from eschorty_ros.core.line.line_history import (
    RECENT_PROFILES,
    LineHistory,
    _compare_polarities,
    _mean_of_blocks,
    _restart_history,
    empty_history,
)
from eschorty_ros.core.line.one_end import _end_that_stays, _restore_ends
from eschorty_ros.core.line.pixel_locking import _measure_levels
from eschorty_ros.core.line.scatter import (
    Scatter,
    _clear_scatter,
    _scale,
    _scale_smoothed,
    empty_scatter,
)
from eschorty_ros.core.line.sigma import VARIANCE_PER_WIDTH2, error_model
from eschorty_ros.core.line.smoothing import Smoothing, _reject_isolated, _smooth, empty_smoothing
from eschorty_ros.core.line.two_lines import PROFILES_WITH_TWO, _single_half, empty_two_lines
from eschorty_ros.core.line.unusual import (
    UsualWidths,
    Widths,
    _is_known,
    _keep_widths,
    _mark_unusual,
    _restart_widths,
    empty_usual_widths,
    empty_widths,
)
from eschorty_ros.core.line.window import FRACTION
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.profiles import LineRows
from eschorty_ros.core.reconstruction.region import region, rows_taken
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.storage import FEW_EVENTS, MIXED, SENSOR_EDGE

WINDOW_EVENTS = 1 << 21
"""Events after which, with the next profile, the estimate of the line starts again.

So a window depends on no earlier events but those that the first window has learned from: the
footprint, the usual widths and the line's width. Windows can be reconstructed at the same time.
While the sensor's edge cuts a line learning goes on.
"""
# Profiles of the first window, as full of points as any, that show the usual widths.
_KNOWN_PROFILES = 16
_OUTPUT_PROFILES = 64
_RECENT = np.int64(RECENT_PROFILES)
_WIDTH_MIN_DOF = 64
# Times the limit that a line may be wide, and from which on that is a fault.
_WIDER, _TOO_WIDE = 4, 1.5
# Evenly filled windows measure 1.77 times their width, those of a line once: in the middle.
_FILLED = np.sqrt(HALF_PER_SIGMA / FRACTION / np.sqrt(3.0))


COUNTERS = (
    "events_binned",
    "events_before_first_edge",
    "events_outside_roi",
    "events_over_column_limit",
    "events_gated",
    "periods_closed",
    "periods_empty",
    "profiles_too_wide",
    "profiles_one_end",
    "columns_too_few_events",
    "columns_weak",
    "columns_ambiguous",
    "columns_isolated",
    "columns_two_returns",
    "columns_unmodulated",
    "events_unmodulated",
    "points_burst_shift",
    "points_followed",
    "points_one_polarity",
    "footprints",
    "footprints_asymmetric",
)
CLOSED, EMPTY, FILLED = 0, 1, 2
"""Status of the open period: there is none, it has no events, it has some."""
_STATE = (
    "period",
    "edge_us",
    "part_us",  # where the part of the gate begins
    "status",  # CLOSED, EMPTY or FILLED
    "half",  # half width of the open period's windows, fixed point
    "rows",  # in the output
    "full",  # 1 while a column needs more room
    "window",  # events since the estimate of the line started
    "profiles",  # since then
    "one_end",  # profiles since then whose lines have one end in the same rows
    "known_one_end",  # 1 where almost all of the first window have
    "over",  # 1 where a pass ended with the window
    "points",  # since the restart
    "points_most",  # the most of a profile
    "known_half",  # ``half`` with which later windows begin, 0 until it is known
    "recent_points",  # sum over recent profiles, as the next one
    "recent_events",
)


class _Output(NamedTuple):
    """Rows of closed periods as in `LineRows`; arrays of equal length."""

    period: NDArray[np.int64]
    edge_us: NDArray[np.int64]
    t_us: NDArray[np.int64]
    column: NDArray[np.uint16]
    row: NDArray[np.float64]
    sigma_row: NDArray[np.float64]
    width_px: NDArray[np.float64]
    events: NDArray[np.uint32]
    return_index: NDArray[np.uint8]
    flags: NDArray[np.uint16]


class Memory(NamedTuple):
    """Settings and memory of the pass from events to rows, its state and what it counts.

    Windows of events begin with the footprint ``known`` and the ``known_widths``. ``two_lines`` are
    the counts of `_single_half`, ``delay`` the sums of `_delay_us`.
    """

    columns: Columns
    estimator: Estimator
    gate: LearnedGate
    blink: Blink
    bursts: Bursts
    footprint: Footprint
    known: Footprint
    known_widths: UsualWidths
    scatter: Scatter
    smoothing: Smoothing
    widths: Widths
    two_lines: NDArray[np.int64]
    history: LineHistory
    light: Light
    delay: Any
    rows: Rows
    row_counts: NDArray[np.int64]
    output: _Output
    window_events: int
    state: Any
    counters: Any


def allocate(settings: Settings, model: RangeModel) -> Memory:
    """Return the memory of a pass."""
    method_code, returns_code = check_method(settings.centroid, settings.returns)
    estimator = Estimator(
        method=method_code,
        returns=returns_code,
        seeded=True,
        events_min=settings.events_min,
        sensor_rows=model.rows,
        rows_taken=rows_taken(settings, model),
        half_max=half_width_fixed(settings.line_width_px),
        line_variance=VARIANCE_PER_WIDTH2 * settings.line_width_px**2,
        error_model=error_model(
            settings.centroid,
            settings.sigma_factor,
            settings.sigma_floor_px,
        ),
    )
    returns = 2 if settings.returns == "all" else 1
    shape = returns, model.columns
    size, none = _OUTPUT_PROFILES * returns * model.columns, LineRows.empty()
    return Memory(
        columns=region(empty_columns(model.columns, settings.column_limit), settings, model),
        estimator=estimator,
        blink=Blink(lines=recent_lines()),
        bursts=empty_bursts(model.columns),
        footprint=make_footprint(estimator.half_max, model.columns),
        known=make_footprint(estimator.half_max, model.columns),
        known_widths=empty_usual_widths(model.columns),
        scatter=empty_scatter(model.columns),
        smoothing=empty_smoothing(
            settings.smoothing_half_width,
            settings.smoothing_gate_px,
            settings.isolation_gate_px,
            settings.isolation_events,
            shape,
        ),
        widths=empty_widths(shape, model.rows),
        two_lines=empty_two_lines(),
        history=empty_history(model.columns),
        light=Light(),
        gate=make_gate(Modulation(70.0), 0),
        delay=record("time_us", "points"),
        rows=empty_rows(*shape),
        row_counts=make_row_counts(),
        output=_Output(*(np.empty(size, getattr(none, name).dtype) for name in _Output._fields)),
        window_events=WINDOW_EVENTS,
        state=record(*_STATE),
        counters=record(*COUNTERS),
    )


def first_choice(settings: Settings) -> int:
    """Return `UNDECIDED` where rows may be those of a learned footprint, else `MEAN_ROWS`."""
    learns = settings.centroid == "mode_mean" and settings.detail == "auto"
    return UNDECIDED if learns or settings.centroid == "learned" else MEAN_ROWS


@kernel(_nrt=True)
def _begin_window(memory):
    """Drop the last rows and the scatter; begin with widths and footprint as far as known."""
    state = memory.state
    state.window = state.profiles = state.one_end = state.recent_points = state.recent_events = 0
    state.half = state.known_half if state.known_half > 0 else memory.estimator.half_max
    memory.columns.seeds[:] = -1
    memory.columns.second_rows[:], memory.columns.events[:] = -1, 0
    memory.two_lines[:] = 0
    _clear_scatter(memory.scatter)
    _clear_bursts(memory.bursts)
    _clear_lines(memory.blink.lines)
    memory.smoothing.errors[:] = 0.0
    memory.delay.time_us = memory.delay.points = 0
    _restart_gate(memory.gate)
    _restart_widths(memory.widths, memory.known_widths)
    _restart_history(memory.history)
    if memory.footprint.state.near_edge == 0:
        _restart_from(memory.footprint, memory.known)


@kernel
def _clear_usual(memory):
    """Clear the usual widths of lines, and their bursts."""
    memory.widths.usual.number[:], memory.widths.below[:] = 0.0, 0.0
    memory.history.shift_px[:] = 0.0
    _clear_bursts(memory.bursts)


@kernel(_nrt=True)
def _clear_line(memory):
    """Clear what is known of the line: widths, bursts, delay and footprint."""
    _clear_usual(memory)
    memory.delay.time_us = memory.delay.points = 0
    _restart_from(memory.footprint, memory.known)


@kernel(inline="always")
def _is_examined(memory, profiles):
    """Return whether the events of some columns are examined one by one: until the width is known.

    Later what they show changes slowly: ``profiles`` of 16 are enough. Full columns have no
    line that can be examined.
    """
    state = memory.state
    known = state.known_half > 0 and state.profiles % RECENT_PROFILES >= profiles
    return _is_windowed(memory.estimator.method) and not known


@kernel(_nrt=True)
def _use_single_line(memory, half):
    """Begin to search for one line where the windows of this profile had two.

    Its rows are the means of both.
    """
    memory.rows.mixed[:] = True
    memory.state.half, memory.columns.seeds[:] = half, -1
    _clear_line(memory)


@kernel
def _adapted_half(half, sums, half_max):
    """Return the half width for the next period: 1.3 x the width of this one's lines, averaged.

    It exceeds the limit where most events of the columns are in the windows, hence the line's, or
    where these are filled evenly, hence too narrow, in most columns: background has few rows.
    """
    line = sums.line
    if line.freedom < _WIDTH_MIN_DOF:
        return half
    measured = HALF_PER_SIGMA * line.width
    filled = measured > _FILLED * half and line.lines > sums.too_few_events + sums.unmodulated
    wider = 3 * line.freedom > 2 * line.events or filled
    limit = half_max * (_WIDER if wider else 1)
    return np.int64(min(max(np.rint(0.5 * (half + measured)), HALF_MIN), limit))


@kernel(_nrt=False)
def _few_events(rows, most, state):
    """Return the number below which a point's events are few: half of the mean, up to ``most``.

    The mean is over recent profiles, since all of the first line on a surface has few events.
    """
    events, points = np.int64(0), np.int64(0)
    returns, columns = rows.row.shape
    for k in range(returns):
        for c in range(columns):
            if not np.isnan(rows.row[k, c]):
                events += rows.events[k, c]
                points += 1
    state.recent_events += events - state.recent_events // _RECENT
    state.recent_points += points - state.recent_points // _RECENT
    return min(0.5 * state.recent_events / max(state.recent_points, 1), float(most))


@kernel(_nrt=False)
def _write(rows, smoothing, few, delay_us, state, output):
    """Write the period's rows after the ``state.rows`` others, by column, nearest return first."""
    returns, columns = rows.row.shape
    period, edge_us = state.period, state.edge_us
    first = end = np.uintp(state.rows)
    for c in range(np.uintp(columns)):
        index = 0
        for k in range(np.uintp(returns)):
            # Overwritten by the next point where there is none here.
            output.column[end], output.flags[end], output.return_index[end] = c, k, index
            found = not np.isnan(rows.row[k, c])
            index += found
            end += np.uintp(found)
    for i in range(first, end):
        at = np.uintp(output.flags[i]), np.uintp(output.column[i])
        output.period[i] = period
        output.edge_us[i] = edge_us
        output.t_us[i] = edge_us + rows.mean_dt_us[at] - delay_us
        output.row[i] = smoothing.row[at]
        output.sigma_row[i] = np.sqrt(smoothing.sigma2[at])
        output.width_px[i] = np.sqrt(rows.variance[at])
        output.events[i] = rows.events[at]
        output.flags[i] = (
            (MIXED if rows.mixed[at] else 0)
            | (SENSOR_EDGE if rows.truncated[at] else 0)
            | (FEW_EVENTS if rows.events[at] < few else 0)
        )
    state.rows = end


@kernel(inline="always")
def _gate_late(memory):
    """Leave out the late events that are not the line's, where the phase of the light is gated."""
    columns, gate, counters = memory.columns, memory.gate, memory.counters
    if gate.choices.size > 0:
        half, levels = memory.state.half, memory.scatter.levels
        if _learn_gate(columns, half, memory.smoothing, memory.history, levels, gate):
            # The events of another gate have another delay and another footprint.
            _clear_line(memory)
        gated = _use_late(columns, gate)
        counters.events_binned -= gated
        counters.events_gated += gated


@kernel(inline="always")
def _count(sums, counters):
    """Count a closed period and its columns."""
    counters.periods_closed += 1
    counters.columns_too_few_events += sums.too_few_events
    counters.columns_weak += sums.weak
    counters.columns_ambiguous += sums.ambiguous
    counters.columns_two_returns += sums.two_returns
    counters.columns_unmodulated += sums.unmodulated
    counters.events_unmodulated += sums.events_unmodulated


@kernel(inline="always")
def _follow(memory, half, restarted):
    """Add the period to the history of the line: its place, polarities and bursts.

    ``restarted`` says that the laser or the period's edge has started again.
    """
    state, columns, blink = memory.state, memory.columns, memory.blink
    history, place = memory.history, state.profiles % BLOCK_COLUMNS
    if restarted:
        _clear_lines(blink.lines)
    _add_lines(columns, half, place, blink)
    _compare_polarities(columns, half, place, history)
    # Before a width is usual, an edge that passes is not seen.
    if _is_windowed(memory.estimator.method) and _is_known(memory.widths):
        common2 = memory.rows.common2[0]
        _compare_bursts(columns, half, state.profiles, blink, common2, memory.bursts, history)
    state.profiles += 1


@kernel(inline="always")
def _loses_one_end(state):
    """Return whether all but one in 16 profiles of the window have one end in the same rows."""
    return state.profiles >= _RECENT * max(state.profiles - state.one_end, 1)


@kernel(inline="always")
def _learn_line(memory, half, learns, is_last):
    """Learn the footprint, the widths and the gate, and keep what later windows begin with.

    ``half`` is the half width of the period's windows; the period ``is_last`` in a window of
    events.
    """
    state, counters, footprint = memory.state, memory.counters, memory.footprint
    estimator, rows, history = memory.estimator, memory.rows, memory.history
    enough = state.points >= _KNOWN_PROFILES * max(state.points_most, 1)
    always = estimator.method == _LEARNED
    used = memory.smoothing.used[0]
    if _choose(footprint, rows, used, history, is_last and enough, always):
        # Later windows begin with what is known now.
        _restart_from(memory.known, footprint)
    if learns:
        computations, asymmetric = footprint.state.computations, footprint.state.asymmetric
        step_px = _mean_of_blocks(history.step_px, history.now.points)
        displacement_px = memory.light.lit_share * step_px
        row, sensor_rows = memory.smoothing.row[0], estimator.sensor_rows
        _learn(footprint, rows, row, sensor_rows, displacement_px, half)
        counters.footprints += footprint.state.computations - computations
        counters.footprints_asymmetric += footprint.state.asymmetric - asymmetric
    if state.known_half == 0:
        if half >= estimator.half_max and state.half > half:
            # Its window cuts a line that is wider than expected.
            _clear_usual(memory)
        if enough and footprint.state.choice != UNDECIDED:
            state.known_half = state.half
            state.known_one_end = _loses_one_end(state)
            _keep_widths(memory.widths, memory.known_widths)
            _keep_gate(memory.gate)


@kernel(inline="always")
def _lost_end(memory):
    """Return the end that the readout loses of the lines, as in almost all profiles; 0 for none.

    Edges of a scene may leave one end where it is in some.
    """
    state, end = memory.state, _end_that_stays(memory.history.now)
    memory.counters.profiles_one_end += end != 0
    state.one_end += end != 0
    return end if _loses_one_end(state) or state.known_one_end > 0 else 0


@kernel(_nrt=False)
def _close(memory):
    """Turn the open period into rows."""
    state, counters, estimator = memory.state, memory.counters, memory.estimator
    scatter, smoothing, rows = memory.scatter, memory.smoothing, memory.rows
    _gate_late(memory)
    learns, is_last = _learns(memory.footprint), state.window >= memory.window_events
    half = state.half
    sums = _estimate_columns(
        memory.columns, half, estimator, memory.blink, memory.footprint, rows, memory.row_counts
    )
    state.half = _adapted_half(half, sums, estimator.half_max)
    counters.profiles_too_wide += state.half > _TOO_WIDE * estimator.half_max
    _count(sums, counters)
    counters.columns_isolated += _reject_isolated(rows, smoothing)
    single = np.int64(0)
    if _is_examined(memory, PROFILES_WITH_TWO):
        profiles = state.profiles if state.known_half == 0 else -1
        single = _single_half(memory.columns, half, memory.two_lines, profiles)
    if _is_examined(memory, 1):
        place = (5 * state.profiles) % (BLOCK_COLUMNS - 2)
        _measure_levels(memory.columns, rows.row[0], half, memory.gate.state, place, scatter.levels)
    windowed = _is_windowed(estimator.method)
    _scale(rows, scatter, smoothing, windowed)
    _smooth(rows, smoothing)
    learned = memory.footprint.state.choice == LEARNED_ROWS
    _scale_smoothed(rows, scatter, smoothing, windowed, memory.history.step_px, learned)
    _follow(memory, half, sums.unmodulated > sums.line.lines)
    memory.columns.counts[:] = 0
    few = _few_events(rows, smoothing.isolation_events, state)
    lit_share = memory.light.lit_share
    _mark_unusual(rows, smoothing, memory.widths, memory.history, few, lit_share, windowed)
    end = _lost_end(memory) if windowed else 0
    if single > 0:
        _use_single_line(memory, single)
    followed = _points_followed(memory.history)
    counters.points_followed += followed.points
    counters.points_burst_shift += followed.shifted
    counters.points_one_polarity += followed.of_one_polarity
    _learn_line(memory, half, learns, is_last)
    delay_us = _delay_us(rows, memory.delay, memory.light)
    _use_late_rows(smoothing.row, memory.history)
    if end != 0:
        _restore_ends(rows, smoothing, memory.history.now, end)
    before = state.rows
    _write(rows, smoothing, few, delay_us, state, memory.output)
    points = np.int64(state.rows - before)
    state.points += points
    state.points_most = max(state.points_most, points)
    if is_last and state.known_half > 0:
        _begin_window(memory)
