"""Sort events into the open period, and close it at the next edge."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.boxed import Boxed
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import entry_kernel, kernel, record
from eschorty_ros.core.base.pointer import Pointer
from eschorty_ros.core.evt3 import Decoder, EventArrays
from eschorty_ros.core.evt3.cuts import Cut
from eschorty_ros.core.evt3.state_machine import decode_into
from eschorty_ros.core.evt3.words import EXT_TRIGGER
from eschorty_ros.core.line.blinking import make_blink
from eschorty_ros.core.line.columns import (
    Columns,
    _append,
    _bin,
    _bin_all,
    _bins,
    _clear_refused,
    _needs_room,
    wider_columns,
)
from eschorty_ros.core.line.delay import Light, make_light
from eschorty_ros.core.line.estimators import FULL_COLUMN_METHODS
from eschorty_ros.core.line.learned_gate import make_gate, same_gate
from eschorty_ros.core.line.window import ROW_LAST
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.background_gate import background_gate_us
from eschorty_ros.core.modulation.held_events import NO_EVENTS, Arrays
from eschorty_ros.core.modulation.phase_gate import GATE_LEARNED, _gate_part
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.profile_rows import (
    CLOSED,
    COUNTERS,
    EMPTY,
    FILLED,
    Memory,
    _begin_window,
    _close,
    allocate,
    first_choice,
)
from eschorty_ros.core.reconstruction.profiles import LineRows
from eschorty_ros.core.reconstruction.settings import Settings


class Edges(NamedTuple):
    """Times and numbers of the beginnings of periods."""

    t_us: NDArray[np.int64]
    period: NDArray[np.int64]

    def part(self, begin: int, end: int | None = None) -> Edges:
        """Return the edges from number ``begin`` on, up to before ``end``."""
        return Edges(self.t_us[begin:end], self.period[begin:end])


class Span(NamedTuple):
    """Times of the events to assign; earlier ones count as at ``floor_us``.

    The pass ends before a trigger unless it goes ``through``. With ``one_window`` it ends where
    the estimate of the line starts again (`WINDOW_EVENTS`), or as soon as the usual widths are
    known.
    """

    floor_us: int
    end_us: int
    through: bool = False
    one_window: bool = False


class ProfileAssembler:
    """Turns events and edges in time order into the rows of profiles.

    All memory of the compiled pass is allocated here and reused from period to period.

    Raises ``ArgumentError`` when the sensor has more rows than the packed form of an event.
    """

    def __init__(self, settings: Settings, model: RangeModel) -> None:
        if model.rows > ROW_LAST + 1:
            raise ArgumentError(
                f"rows is {model.rows}; the reconstruction supports {ROW_LAST + 1} at most"
            )
        self._model = model
        self._speed_mm_s = settings.stage_speed_mm_s
        self._profile_us = 0.0
        self._done: list[LineRows] = []
        self._gate_us = settings.phase_gate_us
        self._window_rows = settings.line_width_px
        self._takes_background = settings.centroid in FULL_COLUMN_METHODS
        if self._takes_background and self._gate_us == GATE_LEARNED:
            # It is learned from the rows of lines.
            self._gate_us = 0
        self._first_choice = first_choice(settings)
        self._use(allocate(settings, model))

    def _use(self, memory: Memory) -> None:
        self._memory, self._state = memory, memory.state
        self._rows_max = memory.output.row.size - memory.rows.row.size
        self._boxed_memory = Boxed(memory)
        self._boxed = Boxed(
            _Open(
                columns=memory.columns,
                gate=memory.gate.state,
                state=memory.state,
                counters=memory.counters,
                rows_max=self._rows_max,
                memory=self._boxed_memory,
                end=Pointer(_end, self._boxed_memory),
            )
        )

    def restart(
        self, modulation: Modulation, every: int, edge_us: int, first: Arrays | None = None
    ) -> None:
        """Drop the open period, the last rows and the line's width; gate by ``modulation``.

        - ``every``: Number of periods in a profile.
        - ``edge_us``: A rising edge of the laser.
        - ``first``: Events of the first periods, ``None`` where there were none to wait for.
        """
        gate_us = self._gate_us
        if gate_us == GATE_LEARNED and first is not None:
            gate_us = background_gate_us(first, edge_us, modulation, self._window_rows)
        lit = make_light(modulation, every)
        if self._takes_background:
            # It comes at any time.
            lit = lit._replace(delay_max_us=Light().delay_max_us)
        self._use(
            self._memory._replace(
                gate=make_gate(modulation, gate_us),
                blink=make_blink(modulation, every),
                light=lit,
            )
        )
        self._profile_us = every * modulation.period_us
        self.set_stage_speed(self._speed_mm_s)
        self._state["status"] = CLOSED
        self._memory.columns.counts[:] = 0
        known = self._memory.known.state
        known["choice"] = self._first_choice
        known["computations"] = known["all_cut"] = 0
        self._memory.footprint.state["near_edge"] = 0
        for name in ("points", "points_most", "known_half", "known_one_end"):
            self._state[name] = 0
        self._memory.known_widths.number[:] = 0.0
        self._memory.known_widths.scale[:] = 1.0
        self._memory.known_widths.typical["difference"] = 0.0
        _end(self._boxed_memory)

    def begin_window(self, edges: Edges, edge: int, before: ProfileAssembler) -> None:
        """Begin a window, and its first period at an edge, with the settings of ``before``.

        Nothing is counted, and no footprint learned.
        """
        memory = before._memory
        self._use(
            self._memory._replace(
                gate=same_gate(memory.gate),
                blink=memory.blink._replace(lines=self._memory.blink.lines),
                light=memory.light,
                known=memory.known,
                known_widths=memory.known_widths,
                counters=record(*COUNTERS),
            )
        )
        for name in ("known_half", "known_one_end"):
            self._state[name] = before._memory.state[name]
        self._memory.widths.trend.crossing[:] = memory.widths.trend.crossing
        self._memory.columns.counts[:] = 0
        self._memory.footprint.state["near_edge"] = 0
        self._state["status"] = CLOSED
        _end(self._boxed_memory)
        self._state["status"] = EMPTY
        self._state["edge_us"] = self._state["part_us"] = edges.t_us[edge]
        self._state["period"] = edges.period[edge]

    def set_stage_speed(self, mm_s: float) -> None:
        """Set the stage's speed from now on; 0 where it is not known."""
        self._speed_mm_s = mm_s
        step_mm = abs(mm_s) * self._profile_us * 1e-6
        self._memory.widths.trend.crossing[:] = _profiles_per_px(self._model, step_mm)

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
        return dict(zip(COUNTERS, self._memory.counters.item(), strict=True))

    def merge(self, held: Arrays, new: Arrays, edges: Edges) -> None:
        """Assign events to periods and close the periods whose end is reached.

        Events are in time order, first those of ``held``. No more come before the last of
        ``edges``.
        """
        parts = EventArrays(*held), EventArrays(*new)
        size = held[0].size + new[0].size
        event = edge = 0
        while True:
            event, edge = _merge(*parts, edges, event, edge, self._boxed)
            self._widen()
            if event == size and edge == edges.t_us.size:
                return
            self._collect()

    @property
    def has_begun(self) -> bool:
        """Return whether a period is open."""
        return bool(self._state["status"] != CLOSED)

    def merge_words(
        self, words: NDArray[np.uint16], decoder: Decoder, span: Span, edges: Edges
    ) -> Cut:
        """Decode words straight into the columns of the open period and of those that follow.

        Returns the cut after the words read and the edges used. Advances the decoder's state.

        - ``span``: The pass stops before the first event at its end or later.
        - ``edges``: Beginnings of periods before the span's end.
        """
        cut = Cut(0, 0)
        while True:
            cut = Cut(*_merge_words(words, cut, decoder.boxed, span, edges, self._boxed))
            full, crowded = self._widen(), self._state["rows"] > self._rows_max
            if crowded:
                self._collect()
            if self.window_is_over or not (full or crowded):
                return cut

    def _widen(self) -> bool:
        """Give the columns more room where one is full; return whether it was so."""
        full = bool(self._state["full"])
        if full:
            self._use(self._memory._replace(columns=wider_columns(self._memory.columns)))
            self._state["full"] = 0
        return full

    def close(self) -> None:
        """Close the open period if it has events; it stays open for further ones."""
        if self._state["status"] == FILLED:
            again = Edges(*(np.array([self._state[name]]) for name in ("edge_us", "period")))
            self.merge(NO_EVENTS, NO_EVENTS, again)

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


def _profiles_per_px(model: RangeModel, step_mm: float) -> Array:
    """Return by row the profiles in which an edge crosses a px of the line; 0 if not known.

    The stage moves by ``step_mm`` from profile to profile.
    """
    try:
        rows_per_mm = model.rows_per_mm_off_sheet(model.range_mm(np.arange(model.rows)))
    except ArgumentError:
        # The build has no lens at which a point beside the sheet has an image.
        return np.zeros(model.rows)
    rows_per_profile = step_mm * rows_per_mm
    known = np.isfinite(rows_per_profile) & (rows_per_profile > 0.0)
    return np.divide(1.0, rows_per_profile, out=np.zeros(model.rows), where=known)


@kernel
def _count(events, period):
    """Count the events read of the open period."""
    counters, refused = period.counters, period.columns.refused
    period.state.window += events
    refusals = refused.over_limit + refused.outside_region + refused.gated
    counters.events_binned += events - refusals
    counters.events_over_column_limit += refused.over_limit
    counters.events_outside_roi += refused.outside_region
    counters.events_gated += refused.gated


@kernel
def _fill(events, first, limit_us, period):
    """Sort the events before ``limit_us`` into the open period; return the index of the next."""
    state = period.state
    if state.status == CLOSED:
        i = first
        while i < events.t.size and events.t[i] < limit_us:
            i += 1
        period.counters.events_before_first_edge += i - first
        return i
    state.status = FILLED
    end, state.full = _append(events, first, limit_us, state.edge_us, period.columns, period.gate)
    if not state.full:
        _count(end - first, period)
    return end


class _Open(NamedTuple):
    """What the events of the open period change, and the kernel that ends it, with its memory.

    ``rows_max`` is the number of rows that leaves room for another profile.
    """

    columns: Columns
    gate: Any
    state: Any
    counters: Any
    rows_max: int
    memory: Boxed
    end: Pointer


@entry_kernel
def _end(boxed):
    """Turn the open period into rows; begin a window where none is open. Return ``True``."""
    memory = boxed.content
    if memory.state.status == FILLED:
        _close(memory)
    else:
        _begin_window(memory)
    return True


@kernel(inline="always")
def _begin_period(edges, edge, period):
    """Close the open period and begin the next at an edge."""
    state = period.state
    if state.status == FILLED:
        if not period.end(period.memory):
            raise RuntimeError("a profile failed; the reason is above")
    elif state.status == EMPTY:
        period.counters.periods_empty += 1
    state.status = EMPTY
    state.edge_us = state.part_us = edges.t_us[edge]
    state.period = edges.period[edge]


@kernel
def _merge_part(events, edges, i, edge, drain, period):
    """Merge events from ``i`` on, and with ``drain`` the edges after the last one."""
    state, t, edges_us = period.state, events.t, edges.t_us
    far = np.int64(1 << 62)
    while True:
        limit_us = edges_us[edge] if edge < edges_us.size else far
        if i < t.size and t[i] < limit_us:
            i = _fill(events, i, limit_us, period)
            if state.full:
                return i, edge
        if edge == edges_us.size or (i == t.size and not drain):
            return i, edge
        if state.status == FILLED and state.rows > period.rows_max:
            return i, edge
        # In the dark many periods end at once.
        first, next_us = edge, t[i] if i < t.size else far
        while edge + 1 < edges_us.size and edges_us[edge + 1] <= next_us:
            edge += 1
        _begin_period(edges, edge, period)
        period.counters.periods_empty += edge - first
        edge += 1


@entry_kernel
def _merge(held, new, edges, i, edge, boxed):
    """Merge events from ``i`` on, first those of ``held``, with edges from ``edge`` on.

    A period is closed when an event reaches its end or after the last event. Events and edges
    remain when the output has no room for another profile.
    """
    period, size = boxed.content, held.t.size
    if i < size:
        i, edge = _merge_part(held, edges, i, edge, False, period)
        if i < size:
            return i, edge
    i, edge = _merge_part(new, edges, i - size, edge, True, period)
    return size + i, edge


@kernel
def _pass_trigger(sink, triggers, m, t_us, word, n, event_us):
    """Leave out a trigger: the edges are known."""


_decode_into_bins = decode_into(_bin, "bins", _pass_trigger)
_decode_all_into_bins = decode_into(_bin_all, "all_bins", _pass_trigger)


@kernel(_nrt=False)
def _copy(counts, numbers, other_counts, other_numbers):
    """Copy the columns' counts and the decoder's numbers to others."""
    for c in range(np.uintp(counts.size)):
        other_counts[c] = counts[c]
    for k in range(np.uintp(numbers.size)):
        other_numbers[k] = numbers[k]


@kernel(_nrt=False)
def _pass(words, cut, decoder, span, edges, period, before):
    """Decode words as `_merge_words`, without references; ``before`` is room to undo a part in."""
    columns, gate, state = period.columns, period.gate, period.state
    i, edge = np.uint64(cut.word), cut.edge
    state.over = 0
    while True:
        # A profile may change the gate.
        takes_all = gate.step == 0 and columns.row_first.size == 0
        end_us = edges.t_us[edge] if edge < edges.t_us.size else span.end_us
        _copy(columns.counts, decoder.numbers, *before)
        _clear_refused(columns.refused)
        floor_us = max(state.edge_us, span.floor_us)
        part = _gate_part(max(state.part_us, floor_us), state.edge_us, gate)
        bins = _bins(columns, part, gate.keeps_late > 0, state.edge_us, floor_us)
        limit_us = min(end_us, part.end_us)
        if takes_all:
            end, events, _ = _decode_all_into_bins(words, i, limit_us, span.through, decoder, bins)
        else:
            end, events, _ = _decode_into_bins(words, i, limit_us, span.through, decoder, bins)
        if _needs_room(columns):
            _copy(*before, columns.counts, decoder.numbers)
            state.full = 1
            break
        i = end
        if events > 0:
            state.status = FILLED
            _count(np.int64(events), period)
        if i == np.uint64(words.size) or words[i] >> 12 == EXT_TRIGGER:
            break
        if limit_us < end_us:
            state.part_us = limit_us
            continue
        if edge == edges.t_us.size:
            break
        if state.status == FILLED and state.rows > period.rows_max:
            break
        filled = state.status == FILLED
        learning = state.known_half == 0
        _begin_period(edges, edge, period)
        edge += 1
        learned = learning and state.known_half > 0
        if span.one_window and filled and (learned or state.window == 0):
            state.over = 1
            break
    return np.int64(i), edge


@entry_kernel
def _merge_words(words, cut, boxed_decoder, span, edges, boxed):
    """Decode words into the open period and those that begin at the edges.

    It ends before the first event at the end of ``span`` or later, and unless that goes through
    before a trigger. Words and edges remain when a column or the output has no room.
    """
    period, decoder = boxed.content, boxed_decoder.content
    before = np.empty_like(period.columns.counts), np.empty_like(decoder.numbers)
    return _pass(words, cut, decoder, span, edges, period, before)
