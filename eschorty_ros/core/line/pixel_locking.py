"""Pixel locking: the error that the rows of all columns share as the line's ends are whole pixels.

No difference of rows shows it, but the line does. A pixel counts the levels of light that it
passes, and the line has two ends at each level, for either polarity. With x the true place of an
end, it is off by the sum over n of (-1)^n sin(2 pi n x) / (pi n), each term dithered by the end's
scatter s to exp(-2 (pi n s)^2) of its size. Of a line as long as L rows both ends are off alike or
by the opposite: their middle has cos(pi n L) of it. The row is the mean over all levels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS
from eschorty_ros.core.line.window import (
    FRACTION_BITS,
    POLARITY,
    ROW_BITS,
    ROW_MASK,
    TIME_SHIFT,
)
from eschorty_ros.core.modulation.phase_gate import _is_late

# Levels of either polarity that are compared: those above have ends that scatter.
_LEVELS = 16
# Share of the sums that the next columns keep: those of the last 8 count.
_KEPT = 1.0 - 1.0 / 8.0
# The squared second term, which stands for all that follow: 1/4 + 1/9 + ...
_SECOND2 = np.pi**2 / 6.0 - 1.0
# Variance s^2 of an end over the square of the mean size of its leaps, 4 s / sqrt(pi) for ends
# anywhere between two pixels. Their mean square would count those that leap by far too much.
_END2_PER_LEAP2 = np.pi / 16.0
# Largest second difference of ends, px: scatter of so much leaves nothing of the error.
_LEAP_MAX = 2.0
# Second difference of rows that are those of one surface, px.
_SURFACE_PX = 1.0


class Levels(NamedTuple):
    """Sums over columns of recent profiles, by level of light of either polarity.

    By block: ``lengths`` of the line at each level, numbers of ``columns`` and of their ``events``,
    and the ``variance`` that follows. By level: second differences of the line's ends, ``leaps``,
    and their number; what is left of the first term of an end's error in the middle of both, of the
    ``second`` one, and the mean square of both for any length. ``counts``, ``length`` and
    ``row_sum`` are of the columns at hand.
    """

    lengths: NDArray[np.float64]
    columns: NDArray[np.float64]
    events: NDArray[np.float64]
    variance: NDArray[np.float64]
    leaps: NDArray[np.float64]
    differences: NDArray[np.float64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]
    random2: NDArray[np.float64]
    counts: NDArray[np.int64]
    length: NDArray[np.float64]
    row_sum: NDArray[np.float64]


def empty_levels(blocks: int) -> Levels:
    """Return no levels; the first and the last block are outside the sensor."""
    by_block, by_level = np.zeros((3, blocks)), np.zeros((5, 2 * _LEVELS))
    length, row_sum = np.zeros((2, 3, 2 * _LEVELS))
    return Levels(
        lengths=np.zeros((blocks, 2 * _LEVELS)),
        columns=by_block[0],
        events=by_block[1],
        variance=by_block[2],
        leaps=by_level[0],
        differences=by_level[1],
        first=by_level[2],
        second=by_level[3],
        random2=by_level[4],
        counts=np.zeros((2, 1 << ROW_BITS), np.int64),
        length=length,
        row_sum=row_sum,
    )


@kernel
def _clear_levels(levels):
    """Clear all sums."""
    levels.lengths[:], levels.columns[:], levels.events[:] = 0.0, 0.0, 0.0
    levels.variance[:], levels.leaps[:], levels.differences[:] = 0.0, 0.0, 0.0


@kernel(_nrt=False)
def _count_levels(columns, c, half, gate, levels, at):
    """Find length and sum of rows of the line at each level in a column; return the events.

    Those within ``half`` of the column's line and in the ``gate`` count.
    """
    counts, length, row_sum = levels.counts, levels.length[at], levels.row_sum[at]
    length[:], row_sum[:], events = 0.0, 0.0, 0.0
    packed, size = columns.packed, np.uintp(columns.seeds.size)
    for part in (c, size + c):
        begin = np.uintp(columns.starts[part])
        for i in range(begin, begin + np.uintp(columns.counts[part])):
            v = packed[i]
            row, on = np.int64(v & ROW_MASK), np.int64((v & POLARITY) > 0)
            outside = abs((row << FRACTION_BITS) - columns.seeds[c]) > half
            if outside or _is_late(v >> TIME_SHIFT, v & POLARITY, gate):
                continue
            level = counts[on, row]
            counts[on, row] += 1
            events += 1.0
            if level < _LEVELS:
                length[on * _LEVELS + level] += 1.0
                row_sum[on * _LEVELS + level] += row
    for part in (c, size + c):
        begin = np.uintp(columns.starts[part])
        for i in range(begin, begin + np.uintp(columns.counts[part])):
            counts[:, packed[i] & ROW_MASK] = 0
    return events


@kernel(_nrt=False)
def _add_ends(levels, block):
    """Add the three columns at hand to the sums, lengths to those of a block."""
    length, row_sum = levels.length, levels.row_sum
    for k in range(np.uintp(2 * _LEVELS)):
        lengths = length[0, k] + length[1, k] + length[2, k]
        levels.lengths[block, k] = _KEPT * levels.lengths[block, k] + lengths
        if min(length[0, k], length[1, k], length[2, k]) == 0.0:
            continue
        wider = length[0, k] - 2.0 * length[1, k] + length[2, k]
        middle = row_sum[0, k] / length[0, k] + row_sum[2, k] / length[2, k]
        middle -= 2.0 * row_sum[1, k] / length[1, k]
        levels.leaps[k] += min(abs(middle - 0.5 * wider), _LEAP_MAX)
        levels.leaps[k] += min(abs(middle + 0.5 * wider), _LEAP_MAX)
        levels.differences[k] += 2.0


@kernel(_nrt=False)
def _find_terms(levels):
    """Find what is left of the error of a line's ends in their middle, by level.

    Leaps show the ends' scatter. The mean length over all columns is that of a line at any place
    between two pixels.
    """
    columns = max(levels.columns.sum(), 1.0)
    for k in range(np.uintp(2 * _LEVELS)):
        leap = levels.leaps[k] / max(levels.differences[k], 1.0)
        dithered = np.exp(-2.0 * np.pi**2 * _END2_PER_LEAP2 * leap * leap)
        dithered *= levels.differences[k] > 0.0
        length = levels.lengths[:, k].sum() / columns
        levels.first[k] = dithered * np.cos(np.pi * length)
        levels.second[k] = dithered**4 * np.cos(2.0 * np.pi * length)
        levels.random2[k] = 0.5 * (dithered**2 + _SECOND2 * dithered**8)


@kernel(_nrt=False)
def _locking_variance(levels, begin, end):
    """Return the variance that the rows of some blocks share, 0 where none has been measured.

    What mean lengths miss, as a line's length differs by parts of a pixel from column to column, is
    half of what levels of random lengths have. No error exceeds half a pixel.
    """
    first, second, random2, events = 0.0, 0.0, 0.0, 0.0
    for block in range(begin, end):
        events += levels.events[block]
    for k in range(np.uintp(2 * _LEVELS)):
        length = 0.0
        for block in range(begin, end):
            length += levels.lengths[block, k]
        share = length / max(events, 1.0)
        first += share * levels.first[k]
        second += share * levels.second[k]
        random2 += share * share * levels.random2[k]
    error2 = first * first + _SECOND2 * second * second + 0.5 * random2
    # The square of a sine has a mean of a half.
    return min(0.5 * error2 / np.pi**2, 1.0 / 12.0)


@kernel(_nrt=False)
def _measure_levels(columns, row, half, gate, place, levels):
    """Add three columns next to each other of each block, from its column ``place`` on.

    Columns of two surfaces, or without a line, are left out, and events outside the ``gate``.
    """
    for k in range(np.uintp(2 * _LEVELS)):
        levels.leaps[k] *= _KEPT
        levels.differences[k] *= _KEPT
    blocks = levels.columns.size
    for block in range(1, blocks - 1):
        first = np.uintp((block - 1) * BLOCK_COLUMNS + place)
        last = first + np.uintp(2)
        if last >= row.size:
            continue
        # NaN where a column has no line.
        if not abs(row[first] - 2.0 * row[first + np.uintp(1)] + row[last]) <= _SURFACE_PX:
            continue
        levels.columns[block] = _KEPT * levels.columns[block] + 3.0
        events = 0.0
        for at in range(np.uintp(3)):
            events += _count_levels(columns, first + at, half, gate, levels, at)
        levels.events[block] = _KEPT * levels.events[block] + events
        _add_ends(levels, block)
    _find_terms(levels)
    for block in range(1, blocks - 1):
        levels.variance[block] = _locking_variance(levels, block - 1, block + 2)
