"""Search for the densest window of a column, and for a second return beside it.

An event is one uint32: the row in the low 10 bits, the polarity above them, the time since the
period's edge (us) in the upper 21. A column's events are padded with ``PAD`` to a multiple of
``BLOCK`` entries, so that the inner loops run on full vector registers without a remainder.

All sums are integers, hence exact and independent of the order of the events and of the origin of
the rows. Window centres, half widths and gaps are fixed-point numbers with ``FRACTION_BITS`` binary
places. Centres are rounded half to even: mirroring the rows mirrors every window exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel

ROW_BITS = 10
ROW_MASK = np.uint32((1 << ROW_BITS) - 1)
ROW_LAST = 1022
POLARITY = np.uint32(1 << ROW_BITS)
_POLARITY_SHIFT = np.uint32(ROW_BITS)
TIME_SHIFT = np.uint32(ROW_BITS + 1)
TIME_LIMIT_US = 1 << (31 - ROW_BITS)
PAD = np.uint32(0xFFFFFFFF)
BLOCK = 16
FRACTION_BITS = 6
FRACTION = 1 << FRACTION_BITS
HALF_WIDTH_PER_FWHM = 1.3
FOUND, TOO_FEW, AMBIGUOUS, UNMODULATED = 0, 1, 2, 3

_ITERATIONS_MAX = 5
_ONE_BITS = np.uint32(20)
_ONE = np.uint32(1 << 20)
# Entries summed in 32 bits: 512 times (row or row squared or time) still fits.
CHUNK = np.uintp(512)
# Events up to which counting around each of them is faster than sums over all rows.
_PAIRWISE_MAX = 192
# No event is near this row, so that no row is avoided.
_NOWHERE = -(1 << 40)
# Chance of a false second return per column: one in this many, at most.
_FALSE_SECOND = 1000.0


class Column(NamedTuple):
    """One column of the ``packed`` events: its ``events`` from ``start`` on, padded to blocks.

    The laser is on for the first ``lit_us`` of the period.
    """

    packed: NDArray[np.uint32]
    start: np.int64
    events: np.int64
    blocks: np.int64
    lit_us: np.uint32


class Sums(NamedTuple):
    """Sums over the events of a range of rows; d is the row minus the first row of the range.

    ``out_of_phase`` counts ON events of the dark and OFF events of the light.
    """

    events: np.int64
    d: np.int64
    d2: np.int64
    time_us: np.int64
    out_of_phase: np.int64


class Window(NamedTuple):
    """Sums over the events of rows first..last, and their mean in fixed point."""

    first: np.int64
    last: np.int64
    sums: Sums
    centre: np.int64


class Returns(NamedTuple):
    """Window of a column's strongest return and, if there is a ``second``, of the other one.

    Where the status is ``AMBIGUOUS`` the two are equally strong.
    """

    status: int
    second: bool
    window: Window
    other: Window


class _Densest(NamedTuple):
    """Most events in a box, and the lowest and the highest row whose box has as many."""

    events: np.int64
    lowest: np.int64
    highest: np.int64


@kernel(_nrt=False)
def _pad(packed, end):
    """Fill a block after a column's events."""
    for i in range(np.uintp(BLOCK)):
        packed[np.uintp(end) + i] = PAD


@kernel(_nrt=False)
def _padded_end(packed, start):
    """Return the end of the blocks of a column's events, which begin at ``start``."""
    end = np.uintp(start)
    while packed[end] != PAD:
        end += np.uintp(BLOCK)
    return end


# In line, as kernels that count references to arrays call it, and others that do not.
@kernel(inline="always")
def _column(packed, start, events, lit_us):
    """Return a column, which has been padded."""
    return Column(packed, start, events, (events + BLOCK - 1) // BLOCK, lit_us)


@kernel(_nrt=False, forceinline=True)
def _window_sums(column, first, last):
    """Return the sums over rows first..last.

    The number of events and the sum of d share one register lane: a chunk's sum of d stays below
    ``_ONE``.
    """
    base = np.uint32(first)
    span = np.uint32(last - first)
    events = np.int64(0)
    sum_d = np.int64(0)
    sum_d2 = np.int64(0)
    sum_time = np.int64(0)
    out_of_phase = np.int64(0)
    none, one = np.uint32(0), np.uint32(1)
    begin = np.uintp(column.start)
    padded = begin + np.uintp(column.blocks) * np.uintp(BLOCK)
    while begin < padded:
        end = min(begin + CHUNK, padded)
        both, d2, ts, opposite = none, none, none, none
        for i in range(begin, end):
            v = column.packed[i]
            d = np.uint32((v & ROW_MASK) - base)
            t = v >> TIME_SHIFT
            inside = d <= span
            both = np.uint32(both + (np.uint32(d + _ONE) if inside else none))
            d2 = np.uint32(d2 + (np.uint32(d * d) if inside else none))
            ts = np.uint32(ts + (t if inside else none))
            # The sign of the time until the light ends is 1 where it is on.
            lit = np.uint32(t - column.lit_us) >> np.uint32(31)
            other = np.uint32(((v >> _POLARITY_SHIFT) ^ lit) & one)
            opposite = np.uint32(opposite + (other if inside else none))
        events += np.int64(both >> _ONE_BITS)
        sum_d += np.int64(both & (_ONE - np.uint32(1)))
        sum_d2 += np.int64(d2)
        sum_time += np.int64(ts)
        out_of_phase += np.int64(opposite)
        begin = end
    return Sums(events, sum_d, sum_d2, sum_time, out_of_phase)


@kernel(_nrt=False)
def _window_events(column, first, last):
    """Return the number of events in rows first..last."""
    base = np.uint32(first)
    span = np.uint32(last - first)
    events = np.int64(0)
    begin = np.uintp(column.start)
    padded = begin + np.uintp(column.blocks) * np.uintp(BLOCK)
    while begin < padded:
        end = min(begin + CHUNK, padded)
        inside = np.uint32(0)
        for i in range(begin, end):
            d = np.uint32((column.packed[i] & ROW_MASK) - base)
            inside = np.uint32(inside + np.uint32(d <= span))
        events += np.int64(inside)
        begin = end
    return events


@kernel
def _limits(centre, half, first, last):
    """Return the first and last row within ``half`` of ``centre`` and within first..last."""
    low = (centre - half + FRACTION - 1) >> FRACTION_BITS
    high = (centre + half) >> FRACTION_BITS
    return max(low, first), min(high, last)


@kernel(_nrt=False)
def _full_column(column):
    """Return the window over all rows; its centre is not computed and set to -1."""
    sums = _window_sums(column, 0, ROW_LAST)
    return Window(np.int64(0), np.int64(ROW_LAST), sums, np.int64(-1))


@kernel(_nrt=False, forceinline=True)
def _mean_shift(column, centre, half, first, last):
    """Move a window to the mean of its events, ``_ITERATIONS_MAX`` times at most.

    It stops when the mean moves by a sixteenth of the half width or less: in a window of three
    standard deviations a further step would change the mean by less than a hundredth of one. It
    stays within rows first..last.
    """
    low, high = _limits(centre, half, first, last)
    sums = _window_sums(column, low, high)
    for _ in range(_ITERATIONS_MAX - 1):
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


@kernel(_nrt=False)
def _densest_pairwise(column, radius, avoid, gap):
    """Find the densest box by counting around every event."""
    best = np.int64(0)
    lowest = np.int64(ROW_LAST)
    highest = np.int64(0)
    for i in range(column.start, column.start + column.events):
        row = np.int64(column.packed[i] & ROW_MASK)
        if abs(row * FRACTION - avoid) < gap:
            continue
        support = _window_events(column, max(row - radius, 0), min(row + radius, ROW_LAST))
        if support > best:
            best, lowest, highest = support, row, row
        elif support == best:
            lowest = min(lowest, row)
            highest = max(highest, row)
    return _Densest(best, lowest, highest)


@kernel(_nrt=True)
def _densest_histogram(column, radius, avoid, gap):
    """Find the densest box by sums over the rows: the same one."""
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
    return _Densest(best, lowest, highest)


@kernel(_nrt=False)
def _densest(column, half, avoid, gap):
    """Find the box of half the window's width, centred on an event, with most events.

    No box is centred on an event nearer than ``gap`` to ``avoid``.
    """
    radius = max(half >> (FRACTION_BITS + 1), 1)
    if column.events <= _PAIRWISE_MAX:
        return _densest_pairwise(column, radius, avoid, gap)
    return _densest_histogram(column, radius, avoid, gap)


@kernel
def _rows_nearer(centre, other):
    """Return the range of rows nearer to ``centre`` than to ``other``, without the one between."""
    both = centre + other
    if centre < other:
        return 0, (both - 1) >> (FRACTION_BITS + 1)
    return max((both >> (FRACTION_BITS + 1)) + 1, 0), ROW_LAST


@kernel(_nrt=False)
def _mean_shift_beside(column, half, seed, avoid):
    """Run the mean shift from ``seed`` over the rows nearer to it than to ``avoid``."""
    first, last = _rows_nearer(seed, avoid)
    return _mean_shift(column, seed, half, first, last)


@kernel(_nrt=False)
def _resolve_tie(column, half, densest, avoid):
    """Run the mean shift from the equally dense rows and choose without preferring a direction.

    The window with more events is chosen, then the one with the smaller spread. From windows that
    overlap the mean shift restarts at their common mean; two separate windows that are equal in
    both are ambiguous.
    """
    a = _mean_shift_beside(column, half, densest.lowest * FRACTION, avoid)
    if densest.lowest == densest.highest:
        return Returns(FOUND, False, a, a)
    b = _mean_shift_beside(column, half, densest.highest * FRACTION, avoid)
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
        return Returns(FOUND, False, _mean_shift_beside(column, half, middle, avoid), b)
    return Returns(AMBIGUOUS, True, a, b)


@kernel(_nrt=False)
def _densest_window(column, half):
    """Find the densest window of a column."""
    return _resolve_tie(column, half, _densest(column, half, _NOWHERE, 0), _NOWHERE)


@kernel
def _exceeds_background(events, others, half, rows_taken):
    """Return whether a window has more ``events`` than background of the others' density.

    The background is uniform; the excess has to exceed 4 standard deviations.
    """
    width = (2 * half) / FRACTION + 1.0
    if width >= rows_taken:
        return True
    expected = others * width / (rows_taken - width)
    excess = events - expected
    return excess > 0.0 and excess * excess > 16.0 * expected


@kernel
def _chernoff_exponent(events, expected):
    """Return minus the logarithm of Chernoff's bound on the chance of ``events`` or more."""
    return events * np.log(events / expected) - (events - expected) if events > expected else 0.0


@kernel
def _is_significant(events, others, half, rows_taken):
    """Return whether background has ``events`` in any window of a column with low probability.

    The probability is Chernoff's bound on the Poisson tail, times the number of windows that the
    search chooses from. Its density is that of the ``others`` events outside the two windows and
    one more, in case there are none.
    """
    width = (2 * half) / FRACTION + 1.0
    expected = (others + 1.0) * width / max(rows_taken - 2.0 * width, width)
    choices = max(2.0 * rows_taken / width, 1.0)
    return _chernoff_exponent(events, expected) > np.log(_FALSE_SECOND * choices)


@kernel(_nrt=False)
def _box_events(column, centre, half):
    low, high = _limits(centre, half >> 1, 0, ROW_LAST)
    return _window_events(column, low, high)


@kernel(_nrt=False)
def _second_return(column, half, rows_taken, events_min, a):
    """Search for the return of another surface than that of window ``a``.

    It is 2 full widths at half maximum away or more, the box around it has at least half as many
    events as that around ``a``, and they are significant against background.
    """
    alone = Returns(FOUND, False, a, a)
    gap = np.int64(2.0 * half / HALF_WIDTH_PER_FWHM)
    rest = column.events - a.sums.events
    if rest < events_min or 3 * rest < a.sums.events:
        return alone
    strength = _box_events(column, a.centre, half)
    densest = _densest(column, half, a.centre, gap)
    if 3 * densest.events < strength:
        return alone
    second = _resolve_tie(column, half, densest, a.centre)
    b = second.window
    if second.status != FOUND or abs(a.centre - b.centre) < gap:
        return alone
    if 2 * _box_events(column, b.centre, half) < strength:
        return alone
    if abs(a.centre - b.centre) <= 2 * half:
        # Overlapping windows are each limited to their side of the middle.
        centre_a, centre_b = a.centre, b.centre
        a = _mean_shift_beside(column, half, centre_a, centre_b)
        b = _mean_shift_beside(column, half, centre_b, centre_a)
    if a.sums.events < events_min or b.sums.events < events_min:
        return alone
    others = column.events - a.sums.events - b.sums.events
    return Returns(FOUND, _is_significant(b.sums.events, others, half, rows_taken), a, b)
