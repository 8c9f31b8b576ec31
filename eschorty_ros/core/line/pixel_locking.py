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
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS, _near_sum
from eschorty_ros.core.line.window import FRACTION_BITS, PAD, POLARITY, ROW_BITS, ROW_MASK

# Levels of either polarity that are compared: those above have ends that scatter.
_LEVELS = 16
# Share of the sums that the next columns keep: those of the last 8 count.
_KEPT = 1.0 - 1.0 / 8.0
# The squared second term, which stands for all that follow: 1/4 + 1/9 + ...
_SECOND2 = np.pi**2 / 6.0 - 1.0
# Mean square of a normal distribution over that of its mean size.
_SQUARE_PER_SIZE2 = 0.5 * np.pi
# Largest second difference of ends, px: scatter of so much leaves nothing of the error.
_LEAP_MAX = 2.0
# Second difference of rows that are those of one surface, px.
_SURFACE_PX = 1.0


class Levels(NamedTuple):
    """Sums over columns of recent profiles, by block, and by level of light of either polarity.

    ``lengths`` of the line, second differences of its ends, ``leaps``, and their number, by level;
    numbers of ``columns`` and of their ``events``; and the variance that follows from them.
    ``mean_length`` is by level, that of all blocks. ``counts``, ``length`` and ``row_sum`` are of
    the columns at hand.
    """

    lengths: NDArray[np.float64]
    leaps: NDArray[np.float64]
    differences: NDArray[np.float64]
    columns: NDArray[np.float64]
    events: NDArray[np.float64]
    variance: NDArray[np.float64]
    mean_length: NDArray[np.float64]
    counts: NDArray[np.int64]
    length: NDArray[np.float64]
    row_sum: NDArray[np.float64]


def empty_levels(blocks: int) -> Levels:
    """Return no levels; the first and the last block are outside the sensor."""
    by_level, by_block = np.zeros((3, blocks, 2 * _LEVELS)), np.zeros((3, blocks))
    length, row_sum = np.zeros((2, 3, 2 * _LEVELS))
    return Levels(
        lengths=by_level[0],
        leaps=by_level[1],
        differences=by_level[2],
        columns=by_block[0],
        events=by_block[1],
        variance=by_block[2],
        mean_length=np.zeros(2 * _LEVELS),
        counts=np.zeros((2, 1 << ROW_BITS), np.int64),
        length=length,
        row_sum=row_sum,
    )


@kernel
def _clear_levels(levels):
    """Clear all sums."""
    levels.lengths[:], levels.leaps[:], levels.differences[:] = 0.0, 0.0, 0.0
    levels.columns[:], levels.events[:], levels.variance[:] = 0.0, 0.0, 0.0


@kernel(_nrt=False)
def _count_levels(packed, start, seed, half, levels, at):
    """Find length and sum of rows of the line at each level in a column; return the events."""
    counts, length, row_sum = levels.counts, levels.length[at], levels.row_sum[at]
    length[:], row_sum[:], events = 0.0, 0.0, 0.0
    i = np.uintp(start)
    while packed[i] != PAD:
        row, on = np.int64(packed[i] & ROW_MASK), np.int64((packed[i] & POLARITY) > 0)
        if abs((row << FRACTION_BITS) - seed) <= half:
            level = counts[on, row]
            counts[on, row] += 1
            events += 1.0
            if level < _LEVELS:
                length[on * _LEVELS + level] += 1.0
                row_sum[on * _LEVELS + level] += row
        i += np.uintp(1)
    i = np.uintp(start)
    while packed[i] != PAD:
        counts[:, packed[i] & ROW_MASK] = 0
        i += np.uintp(1)
    return events


@kernel(_nrt=False)
def _add_ends(levels, block):
    """Add the three columns at hand to the sums of a block."""
    length, row_sum = levels.length, levels.row_sum
    for k in range(np.uintp(2 * _LEVELS)):
        lengths = length[0, k] + length[1, k] + length[2, k]
        levels.lengths[block, k] = _KEPT * levels.lengths[block, k] + lengths
        levels.leaps[block, k] *= _KEPT
        levels.differences[block, k] *= _KEPT
        if min(length[0, k], length[1, k], length[2, k]) == 0.0:
            continue
        wider = length[0, k] - 2.0 * length[1, k] + length[2, k]
        middle = row_sum[0, k] / length[0, k] + row_sum[2, k] / length[2, k]
        middle -= 2.0 * row_sum[1, k] / length[1, k]
        levels.leaps[block, k] += min(abs(middle - 0.5 * wider), _LEAP_MAX)
        levels.leaps[block, k] += min(abs(middle + 0.5 * wider), _LEAP_MAX)
        levels.differences[block, k] += 2.0


@kernel(_nrt=False)
def _locking_variance(levels, block):
    """Return the variance that rows near a block share, 0 where no column has been seen.

    The mean size of second differences shows the scatter: their squares would count ends that leap
    to the next pixel by far too much. The mean length over all columns is that of a line at any
    place between two pixels. What it misses, as lengths differ by parts of a pixel from column to
    column, is half of what levels of random lengths have. No error exceeds half a pixel.
    """
    columns, events = _near_sum(levels.columns, block), _near_sum(levels.events, block)
    first, second, random2 = 0.0, 0.0, 0.0
    for k in range(np.uintp(2 * _LEVELS)):
        differences = _near_sum(levels.differences[:, k], block)
        if differences == 0.0:
            continue
        size = _near_sum(levels.leaps[:, k], block) / differences
        dithered = np.exp(-2.0 * np.pi**2 * _SQUARE_PER_SIZE2 * size * size / 6.0)
        share = _near_sum(levels.lengths[:, k], block) / columns * dithered
        first += share * np.cos(np.pi * levels.mean_length[k])
        second += share * dithered**3 * np.cos(2.0 * np.pi * levels.mean_length[k])
        random2 += 0.5 * share * share * (1.0 + _SECOND2 * dithered**6)
    together2 = first * first + _SECOND2 * second * second
    # The square of a sine has a mean of a half.
    error2 = 0.5 * (together2 + 0.5 * random2)
    return min(error2 / (np.pi * max(events / max(columns, 1.0), 1.0)) ** 2, 1.0 / 12.0)


@kernel(_nrt=False)
def _measure_levels(columns, row, half, place, levels):
    """Add three columns next to each other of each block, from its column ``place`` on.

    Columns of two surfaces, or without a line, are left out.
    """
    for block in range(1, levels.columns.size - 1):
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
            c = first + at
            events += _count_levels(
                columns.packed, columns.starts[c], columns.seeds[c], half, levels, at
            )
        levels.events[block] = _KEPT * levels.events[block] + events
        _add_ends(levels, block)
    for k in range(levels.mean_length.size):
        levels.mean_length[k] = levels.lengths[:, k].sum() / max(levels.columns.sum(), 1.0)
    for block in range(1, levels.columns.size - 1):
        levels.variance[block] = _locking_variance(levels, block)
