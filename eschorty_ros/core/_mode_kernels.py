"""Compiled search for the densest window of a column, and for a second return beside it."""

from __future__ import annotations

import numpy as np
from numba import njit

from eschorty_ros.core._window_kernels import (
    FRACTION,
    FRACTION_BITS,
    ROW_BITS,
    ROW_LAST,
    ROW_MASK,
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


@njit(cache=True, nogil=True, error_model="numpy")
def _densest_pairwise(packed, start, n, blocks, radius, avoid, gap):
    best = np.int64(0)
    lowest = np.int64(ROW_LAST)
    highest = np.int64(0)
    for i in range(n):
        row = np.int64(packed[start + i] & ROW_MASK)
        if abs(row * FRACTION - avoid) < gap:
            continue
        low, high = max(row - radius, 0), min(row + radius, ROW_LAST)
        support = _window_count(packed, start, blocks, low, high)
        if support > best:
            best, lowest, highest = support, row, row
        elif support == best:
            lowest = min(lowest, row)
            highest = max(highest, row)
    return best, lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def _densest_histogram(packed, start, n, radius, avoid, gap):
    size = 1 << ROW_BITS
    below = np.zeros(size + 1, np.int64)
    for i in range(n):
        below[(packed[start + i] & ROW_MASK) + np.uint32(1)] += 1
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
    return best, lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def _densest(packed, start, n, blocks, half, avoid, gap):
    """Most events in a box of half the window's width around one of them.

    Events nearer than ``gap`` to ``avoid`` (fixed point) are no centres. Returns that number and
    the lowest and the highest row that reach it.
    """
    radius = max(half >> (FRACTION_BITS + 1), 1)
    if n <= _PAIRWISE_MAX:
        return _densest_pairwise(packed, start, n, blocks, radius, avoid, gap)
    return _densest_histogram(packed, start, n, radius, avoid, gap)


@njit(cache=True, nogil=True, error_model="numpy")
def _side(centre, other):
    """Rows nearer to ``centre`` than to ``other`` (fixed point); the row between is in neither."""
    both = centre + other
    if centre < other:
        return 0, (both - 1) >> (FRACTION_BITS + 1)
    return max((both >> (FRACTION_BITS + 1)) + 1, 0), ROW_LAST


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(packed, start, blocks, half, seed, avoid):
    """Mean shift from ``seed`` that keeps to its side of ``avoid`` (both fixed point)."""
    first, last = _side(seed, avoid)
    return _mean_shift(packed, start, blocks, seed, half, first, last)


@njit(cache=True, nogil=True, error_model="numpy")
def _settle(packed, start, blocks, half, lowest, highest, avoid):
    """Follow two equally dense rows and choose without preferring a direction.

    The window with more events wins, then the one with the smaller spread; windows that overlap
    are restarted from their common mean; two separate windows without any difference leave the
    column undecided. Returns the status, the window and the one from the highest row.
    """
    a = _follow(packed, start, blocks, half, lowest * FRACTION, avoid)
    if lowest == highest:
        return FOUND, a, a
    b = _follow(packed, start, blocks, half, highest * FRACTION, avoid)
    if a[0] != b[0]:
        return FOUND, (a if a[0] > b[0] else b), b
    spread_a = a[0] * a[4] - a[3] * a[3]
    spread_b = b[0] * b[4] - b[3] * b[3]
    if spread_a != spread_b:
        return FOUND, (a if spread_a < spread_b else b), b
    if a[6] == b[6]:
        return FOUND, a, b
    if abs(a[6] - b[6]) <= 2 * half:
        middle = np.int64(np.rint((a[6] + b[6]) / 2.0))
        return FOUND, _follow(packed, start, blocks, half, middle, avoid), b
    return AMBIGUOUS, a, b


@njit(cache=True, nogil=True, error_model="numpy")
def _mode_search(packed, start, n, blocks, half):
    """Densest window, then mean shift; the status, the window, its rival when undecided."""
    _, lowest, highest = _densest(packed, start, n, blocks, half, _NOWHERE, 0)
    return _settle(packed, start, blocks, half, lowest, highest, _NOWHERE)


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _box_count(packed, start, blocks, centre, half):
    low, high = _limits(centre, half >> 1, 0, ROW_LAST)
    return _window_count(packed, start, blocks, low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _apart(packed, start, blocks, half, a, b):
    """Both windows again, each kept to its side of the middle, where they would overlap."""
    if abs(a[6] - b[6]) > 2 * half:
        return a, b
    own = _follow(packed, start, blocks, half, a[6], b[6])
    return own, _follow(packed, start, blocks, half, b[6], a[6])


@njit(cache=True, nogil=True, error_model="numpy")
def _second_return(packed, start, n, blocks, half, rows, events_min, a):
    """Look for another surface than that of window ``a``; whether there is one, and both windows.

    It lies 2 full widths at half maximum away or more (the half width of a window is 1.3 of them),
    the box around it holds at least half as many events as that around ``a``, and background does
    not explain it.
    """
    gap = half * 20 // 13
    if n - a[0] < events_min or 3 * (n - a[0]) < a[0]:
        return False, a, a
    strength = _box_count(packed, start, blocks, a[6], half)
    best, lowest, highest = _densest(packed, start, n, blocks, half, a[6], gap)
    if 3 * best < strength:
        return False, a, a
    status, b, _ = _settle(packed, start, blocks, half, lowest, highest, a[6])
    if status != FOUND or abs(a[6] - b[6]) < gap:
        return False, a, a
    if 2 * _box_count(packed, start, blocks, b[6], half) < strength:
        return False, a, a
    own, b = _apart(packed, start, blocks, half, a, b)
    if own[0] < events_min or b[0] < events_min:
        return False, a, a
    return _beyond_chance(b[0], n - own[0] - b[0], half, rows), own, b
