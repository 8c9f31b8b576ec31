"""Compiled column estimators on packed events.

A column's events are the ``n`` entries of ``packed`` from ``start`` on, each one uint32: the row in
the low 10 bits, the time within the window (microseconds) in the upper 22. They are padded with
``PAD`` to a multiple of ``BLOCK`` entries, so that the inner loops run on whole vector registers
without a remainder.

All sums are integers, hence exact, independent of the events' order and of the row they are counted
from. Window centres are fixed-point numbers with ``FRACTION_BITS`` binary places, rounded half to
even: mirroring the rows mirrors every window exactly.
"""

from __future__ import annotations

import numpy as np
from numba import njit

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
_PAIRWISE_MAX = 192

MODE_MEAN = 0
MEAN = 1
MEDIAN = 2

FOUND = 0
TOO_FEW = 1
AMBIGUOUS = 2


@njit(cache=True, nogil=True, error_model="numpy")
def _pad(packed, start, n):
    """Fill the last block behind ``n`` entries; returns the number of blocks."""
    blocks = (n + BLOCK - 1) // BLOCK
    for i in range(n, blocks * BLOCK):
        packed[start + i] = PAD
    return blocks


@njit(cache=True, nogil=True, error_model="numpy")
def _window_sums(packed, start, blocks, low, high):
    """Count, sum of d, of d squared (d = row - low) and of times over rows low..high.

    Count and sum of d grow in one register lane: a chunk's sum of d stays below ``_ONE``.
    """
    base = np.uint32(low)
    span = np.uint32(high - low)
    count = np.int64(0)
    sum_d = np.int64(0)
    sum_d2 = np.int64(0)
    sum_time = np.int64(0)
    begin = np.uintp(start)
    padded = begin + np.uintp(blocks) * np.uintp(BLOCK)
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
    return count, sum_d, sum_d2, sum_time


@njit(cache=True, nogil=True, error_model="numpy")
def _window_count(packed, start, blocks, low, high):
    base = np.uint32(low)
    span = np.uint32(high - low)
    count = np.int64(0)
    begin = np.uintp(start)
    padded = begin + np.uintp(blocks) * np.uintp(BLOCK)
    while begin < padded:
        end = min(begin + _CHUNK, padded)
        c = np.uint32(0)
        for i in range(begin, end):
            d = np.uint32((packed[i] & ROW_MASK) - base)
            c = np.uint32(c + np.uint32(d <= span))
        count += np.int64(c)
        begin = end
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _limits(centre, half):
    """First and last whole row within ``half`` of ``centre`` (both fixed point)."""
    low = (centre - half + FRACTION - 1) >> FRACTION_BITS
    high = (centre + half) >> FRACTION_BITS
    return max(low, 0), min(high, ROW_LAST)


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_shift(packed, start, blocks, centre, half):
    """Move a window to the mean of its events, ``ITERATIONS_MAX`` times at most.

    It has arrived when the mean lies within a sixteenth of the half width: what a window of three
    standard deviations would still gain is below a hundredth of one. Returns the sums of the last
    window, its low row and the fixed-point mean.
    """
    low, high = _limits(centre, half)
    count, sum_d, sum_d2, sum_time = _window_sums(packed, start, blocks, low, high)
    for _ in range(ITERATIONS_MAX - 1):
        if count == 0:
            break
        moved = np.int64(np.rint((count * low + sum_d) * FRACTION / count))
        step = abs(moved - centre)
        centre = moved
        if step * 16 <= half:
            break
        low, high = _limits(centre, half)
        count, sum_d, sum_d2, sum_time = _window_sums(packed, start, blocks, low, high)
    return count, low, sum_d, sum_d2, sum_time, centre


@njit(cache=True, nogil=True, error_model="numpy")
def _densest_pairwise(packed, start, n, blocks, radius):
    best = np.int64(0)
    lowest = np.int64(ROW_LAST)
    highest = np.int64(0)
    for i in range(n):
        row = np.int64(packed[start + i] & ROW_MASK)
        low, high = max(row - radius, 0), min(row + radius, ROW_LAST)
        support = _window_count(packed, start, blocks, low, high)
        if support > best:
            best, lowest, highest = support, row, row
        elif support == best:
            lowest = min(lowest, row)
            highest = max(highest, row)
    return lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def _densest_histogram(packed, start, n, radius):
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
        if below[row + 1] == below[row]:
            continue
        support = below[min(row + radius, ROW_LAST) + 1] - below[max(row - radius, 0)]
        if support > best:
            best, lowest, highest = support, np.int64(row), np.int64(row)
        elif support == best:
            highest = np.int64(row)
    return lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def _mode_mean_search(packed, start, n, blocks, half):
    """Densest window, then mean shift; a tie is settled without preferring a direction.

    The lowest and the highest of the equally dense seeds are both followed. The window with more
    events wins, then the one with the smaller spread; windows that overlap are restarted from their
    common mean; two separate windows without any difference leave the column undecided.
    """
    radius = max(half >> (FRACTION_BITS + 1), 1)
    if n <= _PAIRWISE_MAX:
        lowest, highest = _densest_pairwise(packed, start, n, blocks, radius)
    else:
        lowest, highest = _densest_histogram(packed, start, n, radius)
    a = _mean_shift(packed, start, blocks, lowest * FRACTION, half)
    if lowest == highest:
        return FOUND, a
    b = _mean_shift(packed, start, blocks, highest * FRACTION, half)
    if a[0] != b[0]:
        return FOUND, (a if a[0] > b[0] else b)
    spread_a = a[0] * a[3] - a[2] * a[2]
    spread_b = b[0] * b[3] - b[2] * b[2]
    if spread_a != spread_b:
        return FOUND, (a if spread_a < spread_b else b)
    if a[5] == b[5]:
        return FOUND, a
    if abs(a[5] - b[5]) <= 2 * half:
        middle = np.int64(np.rint((a[5] + b[5]) / 2.0))
        return FOUND, _mean_shift(packed, start, blocks, middle, half)
    return AMBIGUOUS, a


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
def _median_row(packed, start, n, counts):
    """Middle row, or the mean of the two middle rows; ``counts`` is zeroed scratch of 1024."""
    low = np.int64(ROW_LAST)
    high = np.int64(0)
    for i in range(n):
        row = np.int64(packed[start + i] & ROW_MASK)
        counts[row] += 1
        low = min(low, row)
        high = max(high, row)
    seen = np.int64(0)
    lower = np.int64(-1)
    upper = np.int64(-1)
    for middle in range(low, high + 1):
        row = np.int64(middle)
        seen += counts[row]
        counts[row] = 0
        if lower < 0 and 2 * seen >= n:
            lower = np.int64(row)
        if upper < 0 and 2 * seen > n:
            upper = np.int64(row)
    return (lower + upper) / 2.0


@njit(cache=True, nogil=True, error_model="numpy")
def _variance(count, sum_d, sum_d2):
    """Sample variance; the numerator is an exact integer, so a constant column gives 0."""
    if count < 2:
        return 0.0
    return (count * sum_d2 - sum_d * sum_d) / (float(count) * (count - 1))


@njit(cache=True, nogil=True, error_model="numpy")
def _sigma2(variance, count, row, rows, factor, floor):
    """Variance of the estimated row, px squared.

    Rows quantise to a twelfth when there is no spread to judge by. A footprint cut by the edge of
    the sensor may be off by up to 0.8 of its spread.
    """
    sigma2 = factor * factor * variance / count + floor * floor
    if count < 2 or variance == 0.0:
        sigma2 = max(sigma2, 1.0 / 12.0 + floor * floor)
    reach = 2.0 * np.sqrt(variance)
    if row < reach or rows - 1.0 - row < reach:
        sigma2 += 0.64 * variance
    return sigma2


@njit(cache=True, nogil=True, error_model="numpy")
def _estimate_column(packed, start, n, method, half, rows, events_min, counts):
    """One column by itself: status, row, events used, variance, sum of times, fixed-point mean."""
    blocks = _pad(packed, start, n)
    status = FOUND
    if method == MODE_MEAN:
        status, found = _mode_mean_search(packed, start, n, blocks, half)
        count, low, sum_d, sum_d2, sum_time, centre = found
        if not _stands_out(count, n, half, rows):
            status = TOO_FEW
    else:
        count, sum_d, sum_d2, sum_time = _window_sums(packed, start, blocks, 0, ROW_LAST)
        low, centre = np.int64(0), np.int64(-1)
    if count < events_min:
        status = TOO_FEW
    row = (count * low + sum_d) / count
    if method == MEDIAN:
        row = _median_row(packed, start, n, counts)
    return status, row, count, _variance(count, sum_d, sum_d2), sum_time, centre


@njit(cache=True, nogil=True, error_model="numpy")
def _estimate_lists(
    packed, offsets, method, half, rows, events_min, factor, floor, scratch, out_row, out_sigma,
    out_variance, out_events, out_status,
):  # fmt: skip
    """Every column of a CSR layout on its own, without seeds."""
    counts = np.zeros(1 << ROW_BITS, np.int64)
    for column in range(offsets.size - 1):
        n = offsets[column + 1] - offsets[column]
        out_row[column] = np.nan
        out_sigma[column] = np.nan
        out_variance[column] = np.nan
        out_events[column] = 0
        out_status[column] = TOO_FEW
        if n < events_min or n == 0:
            continue
        scratch[:n] = packed[offsets[column] : offsets[column + 1]]
        status, row, count, variance, _, _ = _estimate_column(
            scratch, 0, n, method, half, rows, events_min, counts
        )
        out_status[column] = status
        if status != FOUND:
            continue
        out_row[column] = row
        out_events[column] = count
        out_variance[column] = variance
        out_sigma[column] = np.sqrt(_sigma2(variance, count, row, rows, factor, floor))
