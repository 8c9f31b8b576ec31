"""Events that follow the laser, and the removal of those that do not.

ON events follow a rising edge of the laser and OFF events a falling one. With the phase of OFF
events turned back by the duty cycle, a line's events have one direction on the circle of phases,
and those of background, of hot pixels and of things that move have none. Their vector strength R,
the length of the mean unit vector, separates the two without knowing the phase itself. A lamp and
an edge that passes may have bursts as short within one period. Their phases differ from the one
that the lines of a stream have in common.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS
from eschorty_ros.core.line.window import (
    BLOCK,
    CHUNK,
    FRACTION,
    PAD,
    POLARITY,
    ROW_BITS,
    ROW_MASK,
    TIME_SHIFT,
    _chernoff_exponent,
    _column,
    _padded_end,
)
from eschorty_ros.core.modulation import Modulation

# The delays of pixels scatter over a good part of a shorter period.
PERIOD_MIN_US = 900.0
# Least vector strength of a point, and least events times its square: Rayleigh's test. Few events
# reach it only with a square near 1.
STRENGTH_MIN = 0.5
_RAYLEIGH_MIN = 4.0
_SQUARE_ENOUGH = 0.6
# Background reaches this statistic once in 160 000 windows.
_RAYLEIGH_SURE = 12.0
# Length of a burst after an edge, of 2**32 per turn.
_BURST = 1 << 28
# Least exponents of Chernoff's bound for the bursts of one polarity, and for those of both.
_BURST_MIN = 4.0
_BURSTS_MIN = 12.0
_HOT_EVENTS_MIN = 6
# Lengths of the integer unit vectors, and of their sums per event.
_UNIT = 4096.0
# Share of the lines of a stream that the next profile keeps, and the least number of them.
_KEPT = 0.75
_LINES_MIN = 64.0
# Cosines of the eighth of a turn by which a line's phase may differ from the common one, and of the
# 32nd within which half of the lines are: phases that vary with the row or drift have none.
_ALIKE = np.cos(np.pi / 4.0)
_NEAR = np.cos(np.pi / 16.0)


class Blink(NamedTuple):
    """Turns per microsecond and the turn from rising to falling edge, both of 2**32 per turn.

    A ``step`` of 0 is no test. ``lit_us`` is the time from rising to falling edge, 0 where a
    profile has more periods than one. ``lines`` are `recent_lines`.
    """

    lines: Any
    step: np.uint32 = np.uint32(0)
    duty: np.uint32 = np.uint32(0)
    lit_us: np.uint32 = np.uint32(0)


class Vector(NamedTuple):
    """Sum of the unit vectors of ``events`` phases."""

    events: np.int64
    x: np.int64
    y: np.int64


class _LaserTest(NamedTuple):
    """Result of a test of events: they follow the laser, and more than background ever does."""

    follows: bool
    sure: bool


def recent_lines() -> Any:
    """Return the sums over recent lines, zeros: ``x`` and ``y`` are those of their unit vectors.

    The ``number`` is of those that had lines before them, and ``near`` of those near these.
    """
    return record("x", "y", "number", "near", value=0.0)


def make_blink(modulation: Modulation, every: int) -> Blink:
    """Return the test for profiles of ``every`` periods; none where a period is too short."""
    if modulation.period_us < PERIOD_MIN_US:
        return Blink(recent_lines())
    turn = 1 << 32
    return Blink(
        recent_lines(),
        np.uint32(round(turn / modulation.period_us)),
        np.uint32(round(turn * modulation.duty)),
        np.uint32(round(modulation.duty * modulation.period_us) if every == 1 else 0),
    )


@kernel
def _sine(phase):
    """Return the sine of a phase as a parabola, which is within 6 %, times ``_UNIT``.

    Negative values are those of 32-bit words that wrap.
    """
    turn = phase >> np.uint32(16)
    half = turn & np.uint32(0x7FFF)
    value = np.uint32(half * (np.uint32(0x8000) - half)) >> np.uint32(16)
    return value if turn < np.uint32(0x8000) else np.uint32(np.uint32(0) - value)


@kernel(_nrt=False)
def _vector(column, first, last, blink):
    """Return the sum of unit vectors over the events of rows first..last."""
    base = np.uint32(first)
    span = np.uint32(last - first)
    step, duty = blink.step, blink.duty
    quarter = np.uint32(1 << 30)
    none = np.uint32(0)
    events, x, y = np.int64(0), np.int64(0), np.int64(0)
    begin = np.uintp(column.start)
    padded = begin + np.uintp(column.blocks) * np.uintp(BLOCK)
    while begin < padded:
        end = min(begin + CHUNK, padded)
        n, sum_x, sum_y = none, none, none
        for i in range(begin, end):
            v = column.packed[i]
            inside = np.uint32((v & ROW_MASK) - base) <= span
            back = none if v & POLARITY else duty
            phase = np.uint32(np.uint32((v >> TIME_SHIFT) * step) - back)
            n = np.uint32(n + np.uint32(inside))
            sum_x = np.uint32(sum_x + (_sine(np.uint32(phase + quarter)) if inside else none))
            sum_y = np.uint32(sum_y + (_sine(phase) if inside else none))
        events += np.int64(n)
        x += np.int64(np.int32(sum_x))
        y += np.int64(np.int32(sum_y))
        begin = end
    return Vector(events, x, y)


@kernel
def _is_in_phase(sums, blink):
    """Return whether 9 of 10 events of a window are between their edge and the other one.

    Only from 16 events on, which background reaches less often than a vector strength of a half,
    and where a profile has one period.
    """
    return sums.events >= 16 and 10 * sums.out_of_phase <= sums.events and blink.lit_us > 0


@kernel(_nrt=False)
def _cosine(vector, blink):
    """Return the cosine between a phase and that of recent lines; 0 if there are none."""
    x, y = blink.lines.x, blink.lines.y
    lengths2 = (x * x + y * y) * float(vector.x * vector.x + vector.y * vector.y)
    return (vector.x * x + vector.y * y) / np.sqrt(lengths2) if lengths2 > 0.0 else 0.0


@kernel(_nrt=False)
def _is_alike(vector, blink):
    """Return whether a phase is near that which the stream's lines have in common, if any."""
    lines = blink.lines
    no_phase = lines.number < _LINES_MIN or 2.0 * lines.near < lines.number
    return no_phase or _cosine(vector, blink) > _ALIKE


@kernel
def _has_direction(lines):
    """Return whether the mean phase of recent lines is known: their vector strength is enough."""
    least = STRENGTH_MIN * lines.number
    return lines.number >= _LINES_MIN and lines.x * lines.x + lines.y * lines.y > least * least


@kernel(_nrt=False)
def _is_of_the_stream(column, window, blink):
    """Return whether a window's events are in phase, with the laser and with other lines."""
    if not _is_in_phase(window.sums, blink):
        return False
    return _is_alike(_vector(column, window.first, window.last, blink), blink)


@kernel
def _clear_lines(lines):
    """Clear the sums over recent lines."""
    lines.x = lines.y = lines.number = lines.near = 0.0


@kernel(_nrt=False)
def _add_lines(columns, half, place, blink):
    """Add the lines of a profile, one of each block of columns, to those of the stream."""
    x, y, number, near = 0.0, 0.0, 0.0, 0.0
    for c in range(np.uintp(place), np.uintp(columns.seeds.size), np.uintp(BLOCK_COLUMNS)):
        seed = columns.seeds[c]
        if blink.step == 0 or seed < 0:
            continue
        start = columns.starts[c]
        padded = np.int64(_padded_end(columns.packed, start)) - start
        column = _column(columns.packed, start, padded, blink.lit_us)
        first = max((seed - half) // FRACTION, 0)
        vector = _vector(column, first, (seed + half) // FRACTION, blink)
        length = np.sqrt(float(vector.x * vector.x + vector.y * vector.y))
        if length > 0.0:
            x += vector.x / length
            y += vector.y / length
            number += blink.lines.x != 0.0
            near += _cosine(vector, blink) > _NEAR
    lines = blink.lines
    # A short line adds few of them: enough are kept.
    kept = max(_KEPT, _LINES_MIN / max(lines.number, _LINES_MIN))
    lines.x, lines.y = kept * lines.x + x, kept * lines.y + y
    lines.number, lines.near = kept * lines.number + number, kept * lines.near + near


@kernel(_nrt=True)
def _has_bursts(column, first, last, blink):
    """Return whether many ON events are close after a rising edge and OFF ones a falling one.

    Chernoff's bound limits the probability that background has them.
    """
    burst, events = np.zeros(2), np.zeros(2)
    for i in range(column.start, column.start + column.events):
        v = column.packed[i]
        if first <= np.int64(v & ROW_MASK) <= last:
            on = np.int64(v & POLARITY) >> ROW_BITS
            phase = np.uint32((v >> TIME_SHIFT) * blink.step) - (0 if on else blink.duty)
            events[on] += 1.0
            burst[on] += np.uint32(phase) < _BURST
    expected = events * (_BURST / 2.0**32)
    off, on = _chernoff_exponent(burst[0], expected[0]), _chernoff_exponent(burst[1], expected[1])
    return min(off, on) > _BURST_MIN and off + on > _BURSTS_MIN


@kernel(_nrt=False)
def _laser_test(column, first, last, blink):
    """Test whether the events of rows first..last follow the laser."""
    vector = _vector(column, first, last, blink)
    length2 = float(vector.x * vector.x + vector.y * vector.y)
    n = float(vector.events)
    square = length2 / (n * n * _UNIT * _UNIT)
    rayleigh = n * square
    if square > STRENGTH_MIN**2:
        alike = _is_alike(vector, blink)
        follows = rayleigh > min(_RAYLEIGH_MIN, _SQUARE_ENOUGH * n)
        # In a known direction few events have this strength by chance about as rarely.
        if not follows and _has_direction(blink.lines):
            follows = np.sqrt(square) * _cosine(vector, blink) > STRENGTH_MIN
        return _LaserTest(alike & follows, alike & (rayleigh > _RAYLEIGH_SURE))
    # A line that moves while it is lit has events all the time, and a burst at both edges. What
    # passes within a part of the period has one at most.
    bursts = _has_bursts(column, first, last, blink)
    return _LaserTest(bursts, bursts)


@kernel(_nrt=False)
def _without(column, first, last):
    """Remove the events of rows first..last from a column and return what is left."""
    n = np.int64(0)
    for i in range(column.start, column.start + column.events):
        row = np.int64(column.packed[i] & ROW_MASK)
        if not first <= row <= last:
            column.packed[column.start + n] = column.packed[i]
            n += 1
    for i in range(column.start + n, column.start + column.events):
        column.packed[i] = PAD
    return _column(column.packed, column.start, n, column.lit_us)


@kernel(_nrt=False)
def _without_hot_pixels(column, first, last, blink, counts):
    """Remove from a column the pixels of rows first..last that fire without the laser.

    Those have more than twice the events of an average pixel there. ``counts`` is zeroed scratch,
    one per row.
    """
    for i in range(column.start, column.start + column.events):
        counts[column.packed[i] & ROW_MASK] += 1
    events, pixels = np.int64(0), 0
    for row in range(first, last + 1):
        events += counts[row]
        pixels += counts[row] > 0
    hot = max(2.0 * events / max(pixels, 1), _HOT_EVENTS_MIN)
    left = column
    for row in range(first, last + 1):
        if counts[row] >= hot and not _laser_test(left, row, row, blink).follows:
            left = _without(left, row, row)
    counts[:] = 0
    return left
