"""Cut events into modulation periods and turn each into the rows of a profile."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.evt3 import Decoder, EventArrays
from eschorty_ros.core.evt3.decoder import decode_into
from eschorty_ros.core.evt3.words import EXT_TRIGGER
from eschorty_ros.core.line.blinking import Blink, blink
from eschorty_ros.core.line.centroid import (
    _LEARNED,
    CENTROIDS,
    FULL_COLUMN_METHODS,
    Estimator,
    Rows,
    _estimate_columns,
    _learns,
    check_method,
    empty_rows,
    half_width_fixed,
    make_row_counts,
)
from eschorty_ros.core.line.columns import (
    Columns,
    _append,
    _bin,
    _bin_all,
    _bins,
    _forget_refused,
    _needs_room,
    empty_columns,
    wider_columns,
)
from eschorty_ros.core.line.delay import Light, _delay_us, light
from eschorty_ros.core.line.estimators import HALF_MIN, HALF_PER_SIGMA
from eschorty_ros.core.line.learned import (
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
    _forget_gate,
    _learn_gate,
    _use_late,
    make_gate,
    same_gate,
)
from eschorty_ros.core.line.line_history import _compare_polarities
from eschorty_ros.core.line.scatter import (
    BLOCK_COLUMNS,
    FACTOR_MAX,
    Scatter,
    _forget_scatter,
    _scale,
    _scale_smoothed,
    empty_scatter,
)
from eschorty_ros.core.line.sigma import VARIANCE_PER_WIDTH2, error_model
from eschorty_ros.core.line.smoothing import (
    Smoothing,
    _reject_isolated,
    _smooth,
    empty_smoothing,
)
from eschorty_ros.core.line.unusual import (
    UsualWidths,
    _keep_widths,
    _mark_unusual,
    _restart_widths,
    empty_usual_widths,
    empty_widths,
)
from eschorty_ros.core.line.window import ROW_LAST
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.held_events import EventArrays as Arrays
from eschorty_ros.core.modulation.phase_gate import _gate_part
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.profiles import LineRows
from eschorty_ros.core.reconstruction.region import region
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.storage import FEW_EVENTS, MIXED, SENSOR_EDGE

WINDOW_EVENTS = 1 << 21
"""Events after which, with the next profile, the estimate of the line starts again.

A window of the stream so depends on no event before it, and windows can be reconstructed at the
same time, but for what the first one has learned by then: the footprint when rows are chosen, usual
widths and the line's width a few profiles later. While the sensor's edge cuts a line learning goes
on.
"""
# Profiles of the first window, as full of points as any, that show the usual widths.
_KNOWN_PROFILES = 16
_OUTPUT_PROFILES = 64
_WIDTH_MIN_DOF = 64
# Times the limit that a line may be wide.
_WIDER = 4
_COUNTERS = np.dtype(
    [
        (name, np.int64)
        for name in (
            "events_binned",
            "events_before_first_edge",
            "events_outside_sensor",
            "events_outside_roi",
            "events_over_column_limit",
            "events_gated",
            "periods_closed",
            "periods_empty",
            "profiles_too_wide",
            "columns_too_few_events",
            "columns_ambiguous",
            "columns_isolated",
            "columns_smoothed",
            "columns_two_returns",
            "columns_unmodulated",
            "events_unmodulated",
        )
    ]
)
# ``part_us`` is where the part of the gate begins, ``status`` one of the three below, ``half`` the
# half width of a window for the open period in fixed point, ``rows`` the number of rows in the
# output, ``full`` 1 while a column needs more room, ``window`` the number of events since the
# estimate started, ``over`` 1 where a pass ended with it. ``points`` are those since the restart,
# ``points_most`` the most of a profile, ``known_half`` is 0 until windows begin with what is known.
_STATE = np.dtype(
    [
        (name, np.int64)
        for name in (
            "period", "edge_us", "part_us", "status", "half", "rows", "full", "window", "over",
            "points", "points_most", "known_half",
        )
    ]
)  # fmt: skip
_CLOSED, _EMPTY, _FILLED = 0, 1, 2


class Edges(NamedTuple):
    """Times and numbers of the beginnings of periods."""

    t_us: NDArray[np.int64]
    period: NDArray[np.int64]


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


class _Memory(NamedTuple):
    """Settings and memory of the pass from events to rows."""

    columns: Columns
    estimator: Estimator
    gate: LearnedGate
    blink: Blink
    footprint: Footprint
    known: Footprint
    known_widths: UsualWidths
    scatter: Scatter
    smoothing: Smoothing
    light: Light
    delay: Any
    rows: Rows
    row_counts: NDArray[np.int64]
    output: _Output
    window_events: int


class Span(NamedTuple):
    """Times of the events to assign; earlier ones count as at ``floor_us``.

    With ``one_window`` the pass ends with the window of the estimate, or when the usual widths are
    known.
    """

    floor_us: int
    end_us: int
    one_window: bool = False


class _Progress(NamedTuple):
    """First event, or word, and first edge not processed yet."""

    event: np.int64 | int
    edge: int


class ProfileAssembler:
    """Turns events and edges in time order into the rows of profiles.

    All memory of the compiled pass is allocated here and reused from period to period.

    Parameters
    ----------
    settings : Settings
    model : RangeModel

    Raises
    ------
    ArgumentError
        When the sensor has more rows than the packed form of an event.
    """

    def __init__(self, settings: Settings, model: RangeModel) -> None:
        if model.rows > ROW_LAST + 1:
            raise ArgumentError(
                f"rows is {model.rows}; the reconstruction supports {ROW_LAST + 1} at most"
            )
        self._done: list[LineRows] = []
        self._gate_us = settings.phase_gate_us
        self._first_choice = _first_choice(settings)
        self._counters = np.zeros(1, _COUNTERS)[0]
        self._state = np.zeros(1, _STATE)[0]
        self._memory = _allocate(settings, model)

    def restart(self, modulation: Modulation, every: int) -> None:
        """Drop the open period, the last rows and the line's width; gate by ``modulation``.

        ``every`` is the number of periods in a profile.
        """
        lit = light(modulation, every)
        if CENTROIDS[self._memory.estimator.method] in FULL_COLUMN_METHODS:
            # They hold background, which comes at any time.
            lit = lit._replace(delay_max_us=Light().delay_max_us)
        self._memory = self._memory._replace(
            gate=make_gate(modulation, self._gate_us),
            blink=blink(modulation, every),
            light=lit,
            scatter=self._memory.scatter._replace(laser_edges=2 * every),
        )
        self._state["status"] = _CLOSED
        self._memory.columns.counts[:] = 0
        known = self._memory.known.state
        known["choice"] = self._first_choice
        known["computations"] = known["cut_computations"] = 0
        self._memory.footprint.state["near_edge"] = 0
        self._state["points"] = self._state["points_most"] = self._state["known_half"] = 0
        self._memory.known_widths.number[:] = 0.0
        self._memory.known_widths.median["difference"] = 0.0
        _begin_window(self._memory, self._state)

    def begin_window(self, edges: Edges, edge: int, before: ProfileAssembler) -> None:
        """Begin a window, and its first period at an edge, with the settings of ``before``.

        Nothing is counted, and no footprint learned.
        """
        memory = before._memory
        self._memory = self._memory._replace(
            gate=same_gate(memory.gate),
            blink=memory.blink,
            light=memory.light,
            scatter=self._memory.scatter._replace(laser_edges=memory.scatter.laser_edges),
            known=memory.known,
            known_widths=memory.known_widths,
        )
        self._state["known_half"] = before._state["known_half"]
        self._memory.columns.counts[:] = 0
        self._counters = np.zeros(1, _COUNTERS)[0]
        self._state["rows"] = 0
        self._done = []
        self._memory.footprint.state["near_edge"] = 0
        _begin_window(self._memory, self._state)
        self._state["status"] = _EMPTY
        self._state["edge_us"] = self._state["part_us"] = edges.t_us[edge]
        self._state["period"] = edges.period[edge]

    @property
    def window_is_over(self) -> bool:
        """Return whether the last pass ended with the window, or as the usual widths were known."""
        return bool(self._state["over"])

    @property
    def events_left(self) -> int:
        """Events after which the window ends, with the profile."""
        return int(self._memory.window_events - self._state["window"])

    @property
    def is_learning(self) -> bool:
        """Return whether the first window still learns what later ones begin with."""
        return bool(self._state["known_half"] == 0)

    @property
    def is_cut(self) -> bool:
        """Return whether the sensor's edge cuts the line of the last profile."""
        return bool(self._memory.footprint.state["near_edge"])

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return dict(zip(_COUNTERS.names or (), self._counters.item(), strict=True))

    def merge(self, held: Arrays, new: Arrays, edges: Edges) -> None:
        """Assign events to periods and close the periods whose end is reached.

        Parameters
        ----------
        held, new : tuple of ndarray
            Times in us, columns, rows and polarities in time order, first those of ``held``.
        edges : Edges
            No more events come before the last one.
        """
        parts = EventArrays(*held), EventArrays(*new)
        size = held[0].size + new[0].size
        progress = _Progress(0, 0)
        while True:
            progress = _merge(*parts, edges, progress, self._memory, self._state, self._counters)
            self._widen()
            if progress.event == size and progress.edge == edges.t_us.size:
                return
            self._collect()

    @property
    def has_begun(self) -> bool:
        """Return whether a period is open."""
        return bool(self._state["status"] != _CLOSED)

    def merge_words(
        self, words: NDArray[np.uint16], decoder: Decoder, span: Span, edges: Edges
    ) -> tuple[np.int64 | int, int]:
        """Decode words straight into the columns of the open period and of those that follow.

        Parameters
        ----------
        words : ndarray of uint16
        decoder : Decoder
            Its state is advanced.
        span : Span
            The pass stops before the first event at its end or later, and before a trigger.
        edges : Edges
            Beginnings of periods before the span's end.

        Returns
        -------
        int, int
            Words read and edges used.
        """
        progress = _Progress(0, 0)
        rows_max = self._memory.output.row.size - self._memory.rows.row.size
        while True:
            progress = _merge_words(
                words, progress, decoder.memory, span, edges, self._memory, self._state,
                self._counters,
            )  # fmt: skip
            full, crowded = self._widen(), self._state["rows"] > rows_max
            if crowded:
                self._collect()
            if self.window_is_over or not (full or crowded):
                return progress

    def _widen(self) -> bool:
        """Give the columns more room where one is full; return whether it was so."""
        full = bool(self._state["full"])
        if full:
            self._memory = self._memory._replace(columns=wider_columns(self._memory.columns))
            self._state["full"] = 0
        return full

    def close(self) -> None:
        """Close the open period if it has events; it stays open for further ones."""
        if self._state["status"] == _FILLED:
            none = np.empty(0, "i8"), np.empty(0, "u2"), np.empty(0, "u2"), np.empty(0, "u1")
            again = Edges(*(np.array([self._state[name]]) for name in ("edge_us", "period")))
            self.merge(none, none, again)

    def take(self) -> list[LineRows]:
        """Return the rows of the periods closed since the last call, in parts."""
        self._collect()
        done, self._done = self._done, []
        return done

    def _collect(self) -> None:
        """Copy the rows of the output and empty it."""
        n = int(self._state["rows"])
        self._state["rows"] = 0
        if n:
            output = self._memory.output._asdict()
            self._done.append(
                LineRows(**{name: values[:n].copy() for name, values in output.items()})
            )


def _allocate(settings: Settings, model: RangeModel) -> _Memory:
    method_code, returns_code = check_method(settings.centroid, settings.returns)
    estimator = Estimator(
        method=method_code,
        returns=returns_code,
        seeded=True,
        events_min=settings.events_min,
        sensor_rows=model.rows,
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
    windowed = settings.centroid not in FULL_COLUMN_METHODS
    size, none = _OUTPUT_PROFILES * returns * model.columns, LineRows.empty()
    return _Memory(
        columns=region(empty_columns(model.columns, settings.column_limit), settings, model),
        estimator=estimator,
        blink=Blink(),
        footprint=make_footprint(estimator.half_max, model.columns),
        known=make_footprint(estimator.half_max, model.columns),
        known_widths=empty_usual_widths(),
        scatter=empty_scatter(model.columns, _factor_max(settings)),
        smoothing=empty_smoothing(
            settings.smoothing_half_width,
            float(settings.smoothing_gate_px),
            float(settings.isolation_gate_px),
            settings.isolation_events,
            empty_widths(*shape, settings.sigma_common_px, windowed),
        ),
        light=Light(),
        gate=make_gate(Modulation(70.0), 0),
        delay=record("time_us", "points"),
        rows=empty_rows(*shape),
        row_counts=make_row_counts(),
        output=_Output(*(np.empty(size, getattr(none, name).dtype) for name in _Output._fields)),
        window_events=WINDOW_EVENTS,
    )


def _first_choice(settings: Settings) -> int:
    """Return `MEAN_ROWS` where settings fix the means, else `UNDECIDED`."""
    means = settings.centroid == "mode_mean" and settings.detail == "off"
    return MEAN_ROWS if means or settings.centroid in FULL_COLUMN_METHODS else UNDECIDED


def _factor_max(settings: Settings) -> float:
    """Return the largest factor of a variance by the scatter of rows."""
    if settings.centroid in FULL_COLUMN_METHODS:
        return 0.0
    # The scatter that the compensation of reflectance steps removes does not widen sigma.
    return 1.0 if settings.reflectance_compensation == "on" else FACTOR_MAX


@kernel
def _begin_window(memory, state):
    """Drop the last rows and the scatter; begin with widths and footprint as far as known."""
    state.window = 0
    state.half = state.known_half if state.known_half > 0 else memory.estimator.half_max
    memory.columns.seeds[:] = -1
    memory.columns.rivals[:] = -1
    _forget_scatter(memory.scatter)
    memory.smoothing.errors[:] = 0.0
    memory.delay.time_us = memory.delay.points = 0
    _forget_gate(memory.gate)
    _restart_widths(memory.smoothing.widths, memory.known_widths)
    if memory.footprint.state.near_edge == 0:
        _restart_from(memory.footprint, memory.known)


@kernel
def _adapted_half(half, sums, half_max):
    """Return the half width for the next period: 1.3 x the width of this one's rows, averaged.

    It exceeds the limit where most events of the columns are in the windows, hence the line's.
    """
    if sums.freedom < _WIDTH_MIN_DOF:
        return half
    measured = HALF_PER_SIGMA * np.sqrt(sums.squares / sums.freedom)
    limit = half_max * (_WIDER if 3 * sums.freedom > 2 * sums.events else 1)
    return np.int64(min(max(np.rint(0.5 * (half + measured)), HALF_MIN), limit))


@kernel(_nrt=False)
def _few_events(rows, most):
    """Return the number below which a point's events are few: half of the mean, up to ``most``."""
    total, points = 0.0, 0
    returns, columns = rows.row.shape
    for k in range(returns):
        for c in range(columns):
            if not np.isnan(rows.row[k, c]):
                total += rows.events[k, c]
                points += 1
    return min(0.5 * total / max(points, 1), float(most))


@kernel(_nrt=False)
def _write(rows, smoothing, few, delay_us, state, output):
    """Write the period's rows behind ``state.rows``, by column, nearest return first."""
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


@kernel
def _close(memory, state, counters):
    """Turn the open period into rows."""
    columns, estimator, gate = memory.columns, memory.estimator, memory.gate
    blink, footprint, scatter = memory.blink, memory.footprint, memory.scatter
    smoothing, rows, row_counts = memory.smoothing, memory.rows, memory.row_counts
    if gate.choices.size > 0:
        _learn_gate(columns, state.half, gate)
        gated = _use_late(columns, gate)
        counters.events_binned -= gated
        counters.events_gated += gated
    learns, late = _learns(footprint), state.window >= memory.window_events
    half = state.half
    sums = _estimate_columns(columns, state.half, estimator, blink, footprint, rows, row_counts)
    state.half = _adapted_half(state.half, sums, estimator.half_max)
    counters.profiles_too_wide += state.half > estimator.half_max
    counters.periods_closed += 1
    counters.columns_too_few_events += sums.too_few_events
    counters.columns_ambiguous += sums.ambiguous
    counters.columns_two_returns += sums.two_returns
    counters.columns_unmodulated += sums.unmodulated
    counters.events_unmodulated += sums.events_unmodulated
    counters.columns_isolated += _reject_isolated(rows, smoothing)
    _scale(rows, scatter, smoothing)
    counters.columns_smoothed += _smooth(rows, smoothing)
    _scale_smoothed(rows, scatter, smoothing)
    _compare_polarities(columns, half, state.period % BLOCK_COLUMNS, smoothing.widths.history)
    _mark_unusual(rows, smoothing, memory.light.lit_share)
    enough = state.points >= _KNOWN_PROFILES * max(state.points_most, 1)
    if _choose(footprint, rows.row[0], late and enough, estimator.method == _LEARNED):
        # Later windows begin with what is known now.
        _restart_from(memory.known, footprint)
    if learns:
        uncertain, truncated = rows.uncertain[0], rows.truncated[0]
        _learn(
            footprint, rows.row[0], smoothing.row[0], uncertain, truncated, estimator.sensor_rows
        )
    if state.known_half == 0:
        if half >= estimator.half_max and state.half > half:
            # Its window cuts a line that is wider than expected.
            smoothing.widths.usual.number[:] = 0.0
        if enough and footprint.state.choice != UNDECIDED:
            state.known_half = state.half
            _keep_widths(smoothing.widths, memory.known_widths)
    few = _few_events(rows, smoothing.isolation_events)
    delay_us = _delay_us(rows, memory.delay, memory.light)
    before = state.rows
    _write(rows, smoothing, few, delay_us, state, memory.output)
    points = np.int64(state.rows - before)
    state.points += points
    state.points_most = max(state.points_most, points)
    if late and state.known_half > 0:
        _begin_window(memory, state)


@kernel
def _count(events, outside, refused, state, counters):
    """Count the events read of the open period."""
    state.window += events
    refusals = outside + refused.over_limit + refused.outside_region + refused.gated
    counters.events_binned += events - refusals
    counters.events_outside_sensor += outside
    counters.events_over_column_limit += refused.over_limit
    counters.events_outside_roi += refused.outside_region
    counters.events_gated += refused.gated


@kernel
def _fill(events, first, limit_us, memory, state, counters):
    """Sort the events before ``limit_us`` into the open period; return the index of the next."""
    if state.status == _CLOSED:
        i = first
        while i < events.t.size and events.t[i] < limit_us:
            i += 1
        counters.events_before_first_edge += i - first
        return i
    state.status = _FILLED
    columns, gate = memory.columns, memory.gate.state
    sensor_rows = memory.estimator.sensor_rows
    appended = _append(events, first, limit_us, state.edge_us, columns, sensor_rows, gate)
    state.full = appended.full
    if not appended.full:
        _count(appended.next - first, appended.outside, columns.refused, state, counters)
    return appended.next


@kernel(inline="always")
def _begin_period(edges, edge, memory, state, counters):
    """Close the open period and begin the next at an edge."""
    if state.status == _FILLED:
        _close(memory, state, counters)
    elif state.status == _EMPTY:
        counters.periods_empty += 1
    state.status = _EMPTY
    state.edge_us = state.part_us = edges.t_us[edge]
    state.period = edges.period[edge]


@kernel(inline="always")
def _merge_part(events, edges, i, edge, drain, memory, state, counters):
    """Merge events from ``i`` on, and with ``drain`` the edges behind the last one."""
    rows_max = memory.output.row.size - memory.rows.row.size
    t, edges_us = events.t, edges.t_us
    far = np.int64(1 << 62)
    while True:
        limit_us = edges_us[edge] if edge < edges_us.size else far
        if i < t.size and t[i] < limit_us:
            i = _fill(events, i, limit_us, memory, state, counters)
            if state.full:
                return i, edge
        if edge == edges_us.size or (i == t.size and not drain):
            return i, edge
        if state.status == _FILLED and state.rows > rows_max:
            return i, edge
        # In the dark many periods end at once.
        first, next_us = edge, t[i] if i < t.size else far
        while edge + 1 < edges_us.size and edges_us[edge + 1] <= next_us:
            edge += 1
        _begin_period(edges, edge, memory, state, counters)
        counters.periods_empty += edge - first
        edge += 1


@kernel
def _merge(held, new, edges, progress, memory, state, counters):
    """Merge events, first those of ``held``, with edges from ``progress`` on.

    A period is closed when an event reaches its end or after the last event. Events and edges
    remain when the output has no room for another profile.
    """
    size = held.t.size
    i, edge = progress
    if i < size:
        i, edge = _merge_part(held, edges, i, edge, False, memory, state, counters)
        if i < size:
            return _Progress(i, edge)
    i, edge = _merge_part(new, edges, i - size, edge, True, memory, state, counters)
    return _Progress(size + i, edge)


_decode_into_bins = decode_into(_bin, "bins")
_decode_all_into_bins = decode_into(_bin_all, "all_bins")


@kernel
def _merge_words(words, progress, decoder, span, edges, memory, state, counters):
    """Decode words into the open period and those that begin at the edges.

    It ends before the first event at the end of ``span`` or later, and before a trigger. Words
    and edges remain when a column or the output has no room.
    """
    columns, gate = memory.columns, memory.gate.state
    rows_max = memory.output.row.size - memory.rows.row.size
    i, edge = np.uint64(progress.event), progress.edge
    takes_all = gate.step == 0 and columns.row_first.size == 0
    state.over = 0
    while True:
        end_us = edges.t_us[edge] if edge < edges.t_us.size else span.end_us
        before = columns.counts.copy(), decoder.numbers.copy()
        _forget_refused(columns.refused)
        floor_us = max(state.edge_us, span.floor_us)
        part = _gate_part(max(state.part_us, floor_us), state.edge_us, gate)
        bins = _bins(columns, part, gate.keeps_late > 0, state.edge_us, floor_us)
        limit_us = min(end_us, part.end_us)
        if takes_all:
            end, events, _ = _decode_all_into_bins(words, i, limit_us, False, decoder, bins)
        else:
            end, events, _ = _decode_into_bins(words, i, limit_us, False, decoder, bins)
        if _needs_room(columns):
            columns.counts[:], decoder.numbers[:] = before
            state.full = 1
            break
        i = end
        if events > 0:
            state.status = _FILLED
            _count(np.int64(events), 0, columns.refused, state, counters)
        if i == np.uint64(words.size) or words[i] >> 12 == EXT_TRIGGER:
            break
        if limit_us < end_us:
            state.part_us = limit_us
            continue
        if edge == edges.t_us.size:
            break
        if state.status == _FILLED and state.rows > rows_max:
            break
        filled = state.status == _FILLED
        learning = state.known_half == 0
        _begin_period(edges, edge, memory, state, counters)
        edge += 1
        learned = learning and state.known_half > 0
        if span.one_window and filled and (learned or state.window == 0):
            state.over = 1
            break
    return _Progress(np.int64(i), edge)
