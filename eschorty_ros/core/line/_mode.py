"""Compiled search for the densest window of a column, and for a second return beside it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line._window import (
    FRACTION,
    FRACTION_BITS,
    ROW_BITS,
    ROW_LAST,
    ROW_MASK,
    Window,
    _limits,
    _mean_shift,
    _window_count,
)

FOUND = 0
TOO_FEW = 1
AMBIGUOUS = 2

_PAIRWISE_MAX = 192
# Rows that no event has: the search leaves none out.
_NOWHERE = -(1 << 40)
# Chance of a false second return per column: one in this many, at most.
_FALSE_SECOND = 1000.0


class Densest(NamedTuple):
    """Most events in a box, and the lowest and the highest row whose box holds so many."""

    events: int
    lowest: int
    highest: int


class Returns(NamedTuple):
    """The window of a column's strongest return and, if there is a ``second``, the other's.

    Where the status is ``AMBIGUOUS`` the two are equally strong.
    """

    status: int
    second: bool
    window: Window
    other: Window


@kernel
def _densest_pairwise(column, radius, avoid, gap):
    best = np.int64(0)
    lowest = np.int64(ROW_LAST)
    highest = np.int64(0)
    for i in range(column.start, column.start + column.events):
        row = np.int64(column.packed[i] & ROW_MASK)
        if abs(row * FRACTION - avoid) < gap:
            continue
        low, high = max(row - radius, 0), min(row + radius, ROW_LAST)
        support = _window_count(column, low, high)
        if support > best:
            best, lowest, highest = support, row, row
        elif support == best:
            lowest = min(lowest, row)
            highest = max(highest, row)
    return Densest(best, lowest, highest)


@kernel
def _densest_histogram(column, radius, avoid, gap):
    size = 1 << ROW_BITS
    below = np.zeros(size + 1, np.int64)
    for i in range(column.start, column.start + column.events):
        below[(column.packed[i] & ROW_MASK) + np.uint32(1)] += 1
    for row in range(size):
        below[row + 1] += below[row]
    best = np.int64(0)
    lowest = np.int64(ROW_LAST)
    highest = np.int64(0)
    for row in range(size):
        if below[row + 1] == below[row] or abs(row * FRACTION - avoid) < gap:
            continue
        support = below[min(row + radius, ROW_LAST) + 1] - below[max(row - radius, 0)]
        if support > best:
            best, lowest, highest = support, np.int64(row), np.int64(row)
        elif support == best:
            highest = np.int64(row)
    return Densest(best, lowest, highest)


@kernel
def _densest(column, half, avoid, gap):
    """Most events in a box of half the window's width around one of them.

    Events nearer than ``gap`` to ``avoid`` (fixed point) are no centres.
    """
    radius = max(half >> (FRACTION_BITS + 1), 1)
    if column.events <= _PAIRWISE_MAX:
        return _densest_pairwise(column, radius, avoid, gap)
    return _densest_histogram(column, radius, avoid, gap)


@kernel
def _side(centre, other):
    """Rows nearer to ``centre`` than to ``other`` (fixed point); the row between is in neither."""
    both = centre + other
    if centre < other:
        return 0, (both - 1) >> (FRACTION_BITS + 1)
    return max((both >> (FRACTION_BITS + 1)) + 1, 0), ROW_LAST


@kernel
def _follow(column, half, seed, avoid):
    """Mean shift from ``seed`` that keeps to its side of ``avoid`` (both fixed point)."""
    first, last = _side(seed, avoid)
    return _mean_shift(column, seed, half, first, last)


@kernel
def _settle(column, half, densest, avoid):
    """Follow two equally dense rows and choose without preferring a direction.

    The window with more events wins, then the one with the smaller spread; windows that overlap
    are restarted from their common mean; two separate windows without any difference leave the
    column undecided.
    """
    a = _follow(column, half, densest.lowest * FRACTION, avoid)
    if densest.lowest == densest.highest:
        return Returns(FOUND, False, a, a)
    b = _follow(column, half, densest.highest * FRACTION, avoid)
    if a.sums.events != b.sums.events:
        return Returns(FOUND, False, a if a.sums.events > b.sums.events else b, b)
    spread_a = a.sums.events * a.sums.d2 - a.sums.d * a.sums.d
    spread_b = b.sums.events * b.sums.d2 - b.sums.d * b.sums.d
    if spread_a != spread_b:
        return Returns(FOUND, False, a if spread_a < spread_b else b, b)
    if a.centre == b.centre:
        return Returns(FOUND, False, a, b)
    if abs(a.centre - b.centre) <= 2 * half:
        middle = np.int64(np.rint((a.centre + b.centre) / 2.0))
        return Returns(FOUND, False, _follow(column, half, middle, avoid), b)
    return Returns(AMBIGUOUS, True, a, b)


@kernel
def _mode_search(column, half):
    """Densest window, then mean shift."""
    return _settle(column, half, _densest(column, half, _NOWHERE, 0), _NOWHERE)


@kernel
def _stands_out(count, n, half, rows):
    """Whether ``count`` of ``n`` events exceed what the others would put into the window.

    Uniform background of the density found outside the window, 4 standard deviations.
    """
    width = (2 * half) / FRACTION + 1.0
    if width >= rows:
        return True
    expected = (n - count) * width / (rows - width)
    excess = count - expected
    return excess > 0.0 and excess * excess > 16.0 * expected


@kernel
def _beyond_chance(count, others, half, rows):
    """Whether background alone hardly ever puts ``count`` events into any window of a column.

    ``others`` events lie outside the two windows. Chernoff's bound on the Poisson tail, times the
    windows the search chose from; one more background event than seen guards against none seen.
    """
    width = (2 * half) / FRACTION + 1.0
    expected = (others + 1.0) * width / max(rows - 2.0 * width, width)
    if count <= expected:
        return False
    improbable = count * np.log(count / expected) - (count - expected)
    return improbable > np.log(_FALSE_SECOND * max(2.0 * rows / width, 1.0))


@kernel
def _box_count(column, centre, half):
    low, high = _limits(centre, half >> 1, 0, ROW_LAST)
    return _window_count(column, low, high)


@kernel
def _apart(column, half, a, b):
    """Both windows again, each kept to its side of the middle, where they would overlap."""
    if abs(a.centre - b.centre) > 2 * half:
        return a, b
    own = _follow(column, half, a.centre, b.centre)
    return own, _follow(column, half, b.centre, a.centre)


@kernel
def _second_return(column, half, rows, events_min, a):
    """Look for another surface than that of window ``a``.

    It lies 2 full widths at half maximum away or more (the half width of a window is 1.3 of them),
    the box around it holds at least half as many events as that around ``a``, and background does
    not explain it.
    """
    alone = Returns(FOUND, False, a, a)
    gap = half * 20 // 13
    rest = column.events - a.sums.events
    if rest < events_min or 3 * rest < a.sums.events:
        return alone
    strength = _box_count(column, a.centre, half)
    densest = _densest(column, half, a.centre, gap)
    if 3 * densest.events < strength:
        return alone
    second = _settle(column, half, densest, a.centre)
    b = second.window
    if second.status != FOUND or abs(a.centre - b.centre) < gap:
        return alone
    if 2 * _box_count(column, b.centre, half) < strength:
        return alone
    a, b = _apart(column, half, a, b)
    count_a, count_b = a.sums.events, b.sums.events
    if count_a < events_min or count_b < events_min:
        return alone
    if not _beyond_chance(count_b, column.events - count_a - count_b, half, rows):
        return Returns(FOUND, False, a, b)
    return Returns(FOUND, True, a, b)
