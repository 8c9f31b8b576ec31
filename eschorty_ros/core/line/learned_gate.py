"""The phase gate with which the rows of a stream scatter and lag least, where that pays.

Pixels answer an edge of the laser with a burst of events. Later ones, which they give by themselves
or long after the edge, say less about where the line is. How long the burst is depends on the
camera, so gates of several lengths are compared on a profile: by the scatter of the rows of near
columns, which smoothing reduces, by the lag behind a line that moves from profile to profile, and
by what whole pixels move all rows by, which it does not. No gate is used that moves the rows of
near columns together: the line moves while it is lit, and what it passes counts, too.

Events outside the gate are kept apart, and used in columns that have many of them: a surface that
is darker or moves more than those of that profile.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.line.line_history import _mean_of_blocks
from eschorty_ros.core.line.pixel_locking import (
    _clear_levels,
    _locking_variance,
    _measure_levels,
)
from eschorty_ros.core.line.scatter import APART, _median_difference
from eschorty_ros.core.line.window import FRACTION, POLARITY, ROW_MASK, TIME_SHIFT
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.phase_gate import (
    GATE_LEARNED,
    PhaseGate,
    _is_late,
    phase_gate,
)

# The longest gate is half of the period, each further one half as long.
_LENGTHS = 5
# Columns that are tested for moving together.
_TOGETHER = 16
# Mean square of the sum of their differences over the sum of the squares: 1 by chance, as much as
# columns are alike on a textured surface, and the number of all where the line moves.
_TOGETHER_MAX = 6.0
# Share of the mean square error that a gate leaves at most: it takes time.
_ERROR2_MAX = 0.5
# Median size of the second differences of rows over their standard deviation.
_MEDIAN_DIFFERENCE = 0.6745 * np.sqrt(6.0)
# Standard deviations by which a column's number of late events exceeds the usual one.
_DEVIATIONS = 3.0
# Events for a row.
_EVENTS_MIN = 4
# Displacement from profile to profile, in fixed point, at which a gate lags by a few hundredths of
# a row at most.
_STILL = 3
# Profiles one after the other in which the line moves faster; a jump to another surface is one.
_FASTER_MIN = 3
# Share of the rows that a gate has to keep.
_FOUND_MIN = 0.995


class LearnedGate(NamedTuple):
    """The gate in use, and the choices for one to be learned.

    All have the fields of a `PhaseGate`; the first of the ``choices`` is no gate. The state is
    ``known`` once one is chosen, and has ``changed`` if that is another than before; its ``late``
    is the usual number of late events of a column, ``half`` the half width of the windows of rows
    in which it is chosen, 0 before, and ``moving`` the displacement of the line then. The line has
    moved faster in the last ``faster`` profiles. Windows begin with the gate that is ``kept``.
    """

    state: Any
    kept: Any
    choices: NDArray[np.void]


def make_gate(modulation: Modulation, gate_us: int) -> LearnedGate:
    """Return a gate of fixed length, or one to be learned."""
    if gate_us != GATE_LEARNED:
        return _gate(phase_gate(modulation, gate_us), [])
    lengths_us = [round(modulation.period_us / (2 << k)) for k in range(_LENGTHS)]
    choices = [phase_gate(modulation, length_us) for length_us in lengths_us]
    none = PhaseGate(keeps_late=1)
    return _gate(none, [none, *(gate for gate in choices if gate.step > 0)])


def same_gate(gate: LearnedGate) -> LearnedGate:
    """Return a gate of its own with the same state."""
    return gate._replace(state=gate.state.copy())


def _gate(gate: PhaseGate, choices: list[PhaseGate]) -> LearnedGate:
    states = [_state(one) for one in (gate, gate, *choices)]
    return LearnedGate(states[0], states[1], np.array(states[2:], states[0].dtype))


def _state(gate: PhaseGate) -> Any:
    state = record(*PhaseGate._fields, "known", "changed", "late", "half", "moving", "faster")
    for name, value in gate._asdict().items():
        state[name] = value
    return state


@kernel(_nrt=False)
def _copy_gate(gate, other):
    """Copy the parts of the period, and what is usual with them, to another gate."""
    other.step, other.late, other.half = gate.step, gate.late, gate.half
    other.on_begin, other.on_span = gate.on_begin, gate.on_span
    other.off_begin, other.off_span = gate.off_begin, gate.off_span


@kernel(_nrt=False)
def _restart_gate(gate):
    """Begin to learn again with the gate that is kept, where it is to be learned."""
    if gate.choices.size > 0:
        _copy_gate(gate.kept, gate.state)
        gate.state.known = gate.state.changed = gate.state.faster = 0


@kernel(_nrt=False)
def _keep_gate(gate):
    """Keep the gate for the begin of later windows."""
    _copy_gate(gate.state, gate.kept)


@kernel(_nrt=False)
def _fill_rows(columns, half, gate, row):
    """Fill the mean row of each column's events within ``half`` of its last line and in the gate.

    It is NaN where there are too few. Returns their number.
    """
    found = 0
    for c in range(row.size):
        row[c] = np.nan
        seed = columns.seeds[c]
        if seed < 0:
            continue
        events, total = np.int64(0), np.int64(0)
        for part in (c, row.size + c):
            begin = np.uintp(columns.starts[part])
            for i in range(begin, begin + np.uintp(columns.counts[part])):
                v = columns.packed[i]
                offset = np.int64(v & ROW_MASK) * FRACTION - seed
                if abs(offset) <= half and not _is_late(v >> TIME_SHIFT, v & POLARITY, gate):
                    events += 1
                    total += offset
        if events >= _EVENTS_MIN:
            row[c] = (seed + total / events) / FRACTION
            found += 1
    return found


@kernel
def _move_together(row, others):
    """Return whether the differences of rows of near columns are alike."""
    ratios, blocks = 0.0, 0
    for first in range(0, row.size, _TOGETHER):
        difference = row[first : first + _TOGETHER] - others[first : first + _TOGETHER]
        squares = np.nansum(difference * difference)
        if squares > 0.0:
            ratios += np.nansum(difference) ** 2 / squares
            blocks += 1
    return ratios > _TOGETHER_MAX * blocks


@kernel(_nrt=False)
def _lag2(row, gated, seeds):
    """Return the mean square by which a gate moves rows along with their line, px squared.

    The line has moved from the ``seeds`` of the last profile. That of columns beside shows how far,
    as both differences of one column have its noise.
    """
    products, squares, known = 0.0, 0.0, 0
    for c in range(APART, row.size):
        beside = c - APART
        moved = row[beside] - seeds[beside] / FRACTION
        product = (row[c] - gated[c]) * moved
        if not np.isnan(product):
            products += product
            squares += moved * moved
            known += 1
    return products * products / (squares * known) if squares > 0.0 else 0.0


@kernel(_nrt=False)
def _columns_averaged(smoothing):
    """Return how many columns a smoothed row of the last profile is the mean of, on average."""
    total, points = 0.0, 0
    for c in range(smoothing.row.shape[1]):
        if not np.isnan(smoothing.row[0, c]):
            total += smoothing.used[0, c]
            points += 1
    return total / points if points > 0 else 1.0


@kernel
def _locking2(columns, row, half, gate, levels):
    """Return the variance that all rows of the events in a gate share as pixels are whole."""
    _clear_levels(levels)
    _measure_levels(columns, row, half, gate, 0, levels)
    return _locking_variance(levels, 0, levels.columns.size)


@kernel
def _usual_late(columns, gate):
    """Return the median number of a column's events outside the gate."""
    late = np.zeros(columns.seeds.size, np.int64)
    for c in range(late.size):
        for part in (c, late.size + c):
            begin = np.uintp(columns.starts[part])
            for i in range(begin, begin + np.uintp(columns.counts[part])):
                v = columns.packed[i]
                late[c] += _is_late(v >> TIME_SHIFT, v & POLARITY, gate)
    return np.int64(np.median(late[columns.seeds >= 0]))


@kernel(_nrt=True)
def _learn_gate(columns, half, smoothing, history, levels, gate):
    """Choose the gate from the events of a profile and the lines of the last one.

    A gate is chosen again when the line moves twice as fast, in profiles one after the other, or
    rests after a jump. The ``levels`` are then those of its events. Returns true in the profile
    after the one that changes the gate.
    """
    state = gate.state
    changed, state.changed = state.changed > 0, 0
    # No more than the lines have moved in the last profile.
    step_px = np.minimum(history.step_px, np.abs(history.recent.difference))
    moving = np.int64(_mean_of_blocks(step_px, history.now.points) * FRACTION)
    if state.known > 0:
        uses_gate = state.on_span != gate.choices[0].on_span
        faster = uses_gate and moving > max(2 * state.moving, _STILL)
        rests = state.faster > 0 and not faster
        state.faster = state.faster + 1 if faster else 0
        if state.faster < _FASTER_MIN and not rests:
            return changed
        state.known = state.faster = 0
    if state.half > 0:
        # The gate in use has narrowed the windows, which leave out late events as well.
        half = state.half
    row, gated = np.empty(columns.seeds.size), np.empty(columns.seeds.size)
    found = _fill_rows(columns, half, gate.choices[0], row)
    scatter = _median_difference(row)
    # Rows of background are not those of a line.
    if scatter * FRACTION > half:
        return changed
    averaged = _columns_averaged(smoothing) * _MEDIAN_DIFFERENCE**2
    locking2 = _locking2(columns, row, half, gate.choices[0], levels)
    best, least2 = 0, _ERROR2_MAX * (scatter * scatter + averaged * locking2)
    measured = 0
    for k in range(1, gate.choices.size):
        if _fill_rows(columns, half, gate.choices[k], gated) < _FOUND_MIN * found:
            # A shorter one keeps fewer.
            break
        scatter = _median_difference(gated)
        error2 = scatter * scatter + averaged * _lag2(row, gated, columns.seeds)
        if error2 >= least2 or _move_together(gated, row):
            continue
        error2 += averaged * _locking2(columns, row, half, gate.choices[k], levels)
        measured = k
        if error2 < least2:
            best, least2 = k, error2
    late = _usual_late(columns, gate.choices[best]) if best > 0 else 0
    # Of columns with more late events than usual all count: where none is usual, of all columns.
    chosen = best if late > 0 else 0
    choice = gate.choices[chosen]
    state.known, state.changed = 1, choice.on_span != state.on_span
    _copy_gate(choice, state)
    state.late, state.half, state.moving = late, half, moving
    if measured != chosen:
        _locking2(columns, row, half, choice, levels)
    return changed


@kernel(_nrt=True)
def _use_late(columns, gate):
    """Append late events to the others of columns with many; return the number left out."""
    most = gate.state.late + _DEVIATIONS * np.sqrt(gate.state.late)
    left = np.int64(0)
    packed, counts = columns.packed, columns.counts
    for c in range(columns.seeds.size):
        kept = columns.seeds.size + c
        late = np.uintp(counts[kept])
        counts[kept] = 0
        if late <= most:
            left += np.int64(late)
            continue
        begin, end = np.uintp(columns.starts[kept]), np.uintp(columns.starts[c] + counts[c])
        for i in range(late):
            packed[end + i] = packed[begin + i]
        counts[c] += np.uint32(late)
    return left
