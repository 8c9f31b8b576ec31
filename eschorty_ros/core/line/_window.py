"""Compiled sums over windows of rows, on packed events.

An event is one uint32: the row in the low 10 bits, the time within the window (microseconds) in the
upper 22. A column's events are padded with ``PAD`` to a multiple of ``BLOCK`` entries, so that the
inner loops run on whole vector registers without a remainder.

All sums are integers, hence exact, independent of the events' order and of the row they are counted
from. Window centres are fixed-point numbers with ``FRACTION_BITS`` binary places, rounded half to
even: mirroring the rows mirrors every window exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel

ROW_BITS = 10
ROW_MASK = np.uint32((1 << ROW_BITS) - 1)
TIME_LIMIT_US = 1 << (32 - ROW_BITS)
PAD = np.uint32(0xFFFFFFFF)
BLOCK = 32
FRACTION_BITS = 6
FRACTION = 1 << FRACTION_BITS
ITERATIONS_MAX = 5
ROW_LAST = 1022
_ONE_BITS = np.uint32(20)
_ONE = np.uint32(1 << 20)
# Entries summed in 32 bits: 512 times (row or row squared or time) still fits.
_CHUNK = np.uintp(512)


class Column(NamedTuple):
    """One column: ``events`` entries of ``packed`` from ``start`` on, padded to blocks."""

    packed: NDArray[np.uint32]
    start: int
    events: int
    blocks: int


class Sums(NamedTuple):
    """Sums over the events of a range of rows; d is the row less the range's first."""

    events: int
    d: int
    d2: int
    time_us: int


class Window(NamedTuple):
    """Sums over the events of rows first..last, and their mean in fixed point."""

    first: int
    last: int
    sums: Sums
    centre: int


@kernel
def _padded(packed, start, count):
    """Fill the last block behind ``count`` entries; returns the column."""
    blocks = (count + BLOCK - 1) // BLOCK
    for i in range(count, blocks * BLOCK):
        packed[start + i] = PAD
    return Column(packed, start, count, blocks)


@kernel
def _window_sums(column, low, high):
    """Count, sum of d, of d squared (d = row - low) and of times over rows low..high.

    Count and sum of d grow in one register lane: a chunk's sum of d stays below ``_ONE``.
    """
    packed = column.packed
    base = np.uint32(low)
    span = np.uint32(high - low)
    count = np.int64(0)
    sum_d = np.int64(0)
    sum_d2 = np.int64(0)
    sum_time = np.int64(0)
    begin = np.uintp(column.start)
    padded = begin + np.uintp(column.blocks) * np.uintp(BLOCK)
    while begin < padded:
        end = min(begin + _CHUNK, padded)
        both = np.uint32(0)
        d2 = np.uint32(0)
        ts = np.uint32(0)
        for i in range(begin, end):
            v = packed[i]
            d = np.uint32((v & ROW_MASK) - base)
            inside = d <= span
            both = np.uint32(both + (np.uint32(d + _ONE) if inside else np.uint32(0)))
            d2 = np.uint32(d2 + (np.uint32(d * d) if inside else np.uint32(0)))
            ts = np.uint32(ts + ((v >> np.uint32(ROW_BITS)) if inside else np.uint32(0)))
        count += np.int64(both >> _ONE_BITS)
        sum_d += np.int64(both & (_ONE - np.uint32(1)))
        sum_d2 += np.int64(d2)
        sum_time += np.int64(ts)
        begin = end
    return Sums(count, sum_d, sum_d2, sum_time)


@kernel
def _window_count(column, low, high):
    packed = column.packed
    base = np.uint32(low)
    span = np.uint32(high - low)
    count = np.int64(0)
    begin = np.uintp(column.start)
    padded = begin + np.uintp(column.blocks) * np.uintp(BLOCK)
    while begin < padded:
        end = min(begin + _CHUNK, padded)
        c = np.uint32(0)
        for i in range(begin, end):
            d = np.uint32((packed[i] & ROW_MASK) - base)
            c = np.uint32(c + np.uint32(d <= span))
        count += np.int64(c)
        begin = end
    return count


@kernel
def _limits(centre, half, first, last):
    """First and last whole row within ``half`` of ``centre`` (both fixed point), in first..last."""
    low = (centre - half + FRACTION - 1) >> FRACTION_BITS
    high = (centre + half) >> FRACTION_BITS
    return max(low, first), min(high, last)


@kernel
def _whole_column(column):
    """Window over all rows; its mean is not a window's centre and given as -1."""
    return Window(np.int64(0), np.int64(ROW_LAST), _window_sums(column, 0, ROW_LAST), np.int64(-1))


@kernel
def _mean_shift(column, centre, half, first, last):
    """Move a window to the mean of its events, ``ITERATIONS_MAX`` times at most.

    It has arrived when the mean lies within a sixteenth of the half width: what a window of three
    standard deviations would still gain is below a hundredth of one. It never leaves the rows
    first..last.
    """
    low, high = _limits(centre, half, first, last)
    sums = _window_sums(column, low, high)
    for _ in range(ITERATIONS_MAX - 1):
        if sums.events == 0:
            break
        moved = np.int64(np.rint((sums.events * low + sums.d) * FRACTION / sums.events))
        step = abs(moved - centre)
        centre = moved
        if step * 16 <= half:
            break
        low, high = _limits(centre, half, first, last)
        sums = _window_sums(column, low, high)
    return Window(low, high, sums, centre)
