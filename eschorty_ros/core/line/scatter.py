"""Sigma from the scatter at hand: how much rows of near columns differ, in this stream.

The second difference of the rows of three columns is zero on a smooth surface, so its mean square
is six variances of a single row, less what all of them share. Its ratio to what the estimator
expects scales the expected variance: that of the columns' own rows, which sets the gates of
smoothing, and again that of the smoothed rows, since columns share some of what smoothing should
remove. No column is in the means of two of those. So far apart a surface curves: it is the third
difference of four columns that is zero, or near it.

Differences over more columns have more of what texture moves near columns by together, and by
far more of a surface's shape, which is no scatter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS, _near_sum
from eschorty_ros.core.line.estimators import _mean
from eschorty_ros.core.line.pixel_locking import Levels, _clear_levels, empty_levels

# Columns from one to the next of those whose rows, or widths, are compared, and of close ones.
APART = 5
_CLOSE = 2
# The same for smoothed rows, unless their means have more columns.
_NEAR_APART = 8
_FAR_APART = 16
# Share of a profile's differences that the next keeps.
_KEPT = 0.7
# Differences without which the scatter near a block is not known.
_DIFFERENCES_MIN = 8.0
# The same for smoothed rows: half of a profile's near a block. Fewer are left near edges.
_SMOOTHED_MIN = 12.0
# Differences without which the scatter of a profile is not known.
_OF_PROFILE_MIN = 64
# Square of the second difference of rows that are those of one pixel or the next: no edge of the
# surface, px squared.
_PIXEL2 = 1.0
# Standard deviations beyond which a difference is an edge, or a neighbour is not averaged, and the
# mean square of normal deviates within.
_DEVIATIONS_MAX, _WITHIN2 = 3.0, 0.973
# What near columns share makes squared second differences of columns ``APART`` up to 2.5 times as
# large as close ones, a surface's shape 39 times. Texture of up to 20 columns makes squared third
# differences twice as far apart up to so many times as large, a shape 64 times.
_TEXTURE_MAX = 4.0
# Largest factor of a variance, and one over the least.
_FACTOR_MAX = 64.0


class Differences(NamedTuple):
    """Sums over profiles, by block: squared differences, what is expected, and their number."""

    squares: NDArray[np.float64]
    expected: NDArray[np.float64]
    number: NDArray[np.float64]


class Scatter(NamedTuple):
    """Differences of rows, and ``close`` ones, and ``near`` and ``far`` ones of smoothed rows.

    No difference shows what the ``levels`` do.
    """

    own: Differences
    close: Differences
    near: Differences
    far: Differences
    levels: Levels


def empty_scatter(columns: int) -> Scatter:
    """Return no differences; the first and the last block are outside the sensor."""
    blocks = -(-columns // BLOCK_COLUMNS) + 2
    own, close, near, far = (
        Differences(*sums) for sums in np.zeros((4, len(Differences._fields), blocks))
    )
    return Scatter(own, close, near, far, empty_levels(blocks))


@kernel
def _clear_scatter(scatter):
    """Clear all differences."""
    for sums in (scatter.own, scatter.close, scatter.near, scatter.far):
        sums.squares[:] = 0.0
        sums.expected[:] = 0.0
        sums.number[:] = 0.0
    _clear_levels(scatter.levels)


@kernel(inline="always")
def _add(squares, expected, number, block, sums):
    """Add a profile's sums over a block to the share kept of those before."""
    sums.squares[block] = _KEPT * sums.squares[block] + squares
    sums.expected[block] = _KEPT * sums.expected[block] + expected
    sums.number[block] = _KEPT * sums.number[block] + number


@kernel(_nrt=False)
def _ratio(sums, block, least):
    """Return the ratio of the squares near a block to those expected; -1 where it is not known."""
    if _near_sum(sums.number, block) < least:
        return -1.0
    expected = _WITHIN2 * _near_sum(sums.expected, block)
    return min(max(_near_sum(sums.squares, block) / expected, 1.0 / _FACTOR_MAX), _FACTOR_MAX)


@kernel(_nrt=False)
def _usual_ratio(sums, block, least):
    """Return the ratio near a block, that of the profile where it is not known, and else 1."""
    ratio = _ratio(sums, block, least)
    if ratio >= 0.0:
        return ratio
    return sums.squares.sum() / sums.expected.sum() if sums.number.sum() >= least else 1.0


@kernel(_nrt=False)
def _add_differences(row, sigma2, apart, sums):
    """Add a profile's second differences of rows, so far ``apart``, to the sums.

    Larger ones than scatter has are left out: edges of the surface.
    """
    columns = row.size
    for block in range(1, sums.number.size - 1):
        ratio = _usual_ratio(sums, block, _DIFFERENCES_MIN)
        begin, end = (block - 1) * BLOCK_COLUMNS, min(block * BLOCK_COLUMNS, columns)
        first, last = max(begin, apart), min(end, columns - apart)
        squares, expected, number = 0.0, 0.0, 0.0
        for c in range(np.uintp(first), np.uintp(max(first, last))):
            before, after = c - np.uintp(apart), c + np.uintp(apart)
            square = (row[before] - 2.0 * row[c] + row[after]) ** 2
            expected2 = sigma2[before] + sigma2[after] + 4.0 * sigma2[c]
            if square <= max(_PIXEL2, _DEVIATIONS_MAX**2 * ratio * expected2):
                squares += square
                expected += expected2
                number += 1.0
        _add(squares, expected, number, block, sums)


@kernel(inline="always")
def _third(sigma2, i, j, k, m):
    """Return the variance of the third difference of rows with variances ``sigma2``."""
    return sigma2[i] + sigma2[m] + 9.0 * (sigma2[j] + sigma2[k])


@kernel(_nrt=False)
def _add_smoothed_differences(row, sigma2, averaged, own2, apart_min, sums):
    """Add a profile's third differences of smoothed rows to the sums.

    They are ``apart_min`` columns apart, or so far that none is in two means. Larger ones than
    scatter has are left out, and means of less than half as many columns, so ``averaged``, as the
    others: edges of the surface. Neighbours share columns, so every second difference will do.
    """
    columns = row.size
    for block in range(1, sums.number.size - 1):
        ratio = _usual_ratio(sums, block, _SMOOTHED_MIN)
        begin, end = (block - 1) * BLOCK_COLUMNS, min(block * BLOCK_COLUMNS, columns)
        apart = apart_min
        for c in range(np.uintp(begin), np.uintp(end)):
            apart = max(apart, int(averaged[c]))
        # Of the four columns to the one in whose block their difference is.
        before, after = apart + apart // 2, 2 * apart - apart // 2
        squares, expected, number = 0.0, 0.0, 0.0
        first, last = max(begin, before), min(end, columns - after)
        for pair in range(np.uintp((first + 1) // 2), np.uintp((max(first, last) + 1) // 2)):
            i = np.uintp(2) * pair - np.uintp(before)
            j = i + np.uintp(apart)
            k = j + np.uintp(apart)
            m = k + np.uintp(apart)
            square = (row[m] - row[i] - 3.0 * (row[k] - row[j])) ** 2
            expected2 = _third(sigma2, i, j, k, m)
            least = min(averaged[i], averaged[j], averaged[k], averaged[m])
            most = max(averaged[i], averaged[j], averaged[k], averaged[m])
            largest2 = min(ratio * expected2, _third(own2, i, j, k, m))
            if square <= _DEVIATIONS_MAX**2 * largest2 and 2.0 * least >= most:
                squares += square
                expected += expected2
                number += 1.0
        _add(squares, expected, number, block, sums)


@kernel
def _median_difference(row):
    """Return the median size of the second differences of rows, infinite where few are known."""
    differences = np.abs(row[: -2 * APART] - 2.0 * row[APART:-APART] + row[2 * APART :])
    known = differences[~np.isnan(differences)]
    return np.median(known) if known.size >= _OF_PROFILE_MIN else np.inf


@kernel
def _without_shape(close, wide):
    """Return the ratio of ``wide`` differences, less what only a surface's shape explains."""
    return min(wide, max(close, (_TEXTURE_MAX * close) ** 2 / wide))


@kernel(_nrt=False)
def _own_ratio(scatter, block):
    """Return the ratio of rows near a block; -1 where it is not known."""
    close = _ratio(scatter.close, block, _DIFFERENCES_MIN)
    wide = _ratio(scatter.own, block, _DIFFERENCES_MIN)
    if min(close, wide) < 0.0:
        return max(close, wide)
    return _without_shape(close, wide)


@kernel(_nrt=False)
def _smoothed_ratio(scatter, block):
    """Return the ratio of smoothed rows near a block; -1 where it is not known."""
    near = _ratio(scatter.near, block, _SMOOTHED_MIN)
    far = _ratio(scatter.far, block, _SMOOTHED_MIN)
    if min(near, far) < 0.0:
        return -1.0
    return _without_shape(near, far)


@kernel(_nrt=False)
def _scale(rows, scatter, smoothing, windowed):
    """Scale the variances of a profile by the scatter, and widen the smoothing gates by it.

    Those of rows that are not ``windowed``, over full columns, are as expected.
    """
    returns, columns = rows.row.shape
    _add_differences(rows.row[0], rows.sigma2[0], _CLOSE, scatter.close)
    _add_differences(rows.row[0], rows.sigma2[0], APART, scatter.own)
    for block in range(1, scatter.own.number.size - 1):
        ratio = _own_ratio(scatter, block) if windowed else 1.0
        begin, end = (block - 1) * BLOCK_COLUMNS, min(block * BLOCK_COLUMNS, columns)
        # Independent events scatter more than those of pixels, and bound what is not measured.
        independent = 1.0 if ratio < 0.0 else 0.0
        ratio = ratio if ratio >= 0.0 else 1.0
        for k in range(returns):
            for c in range(np.uintp(begin), np.uintp(end)):
                sigma2, cut = rows.sigma2[k, c], rows.truncated[k, c]
                sigma2 += independent * rows.variance[k, c] / max(rows.events[k, c], 1)
                scattered = _DEVIATIONS_MAX * np.sqrt(2.0 * ratio * sigma2)
                gate_px = max(smoothing.gate_px, scattered)
                smoothing.gates_px[k, c] = smoothing.gate_px if cut else gate_px
                rows.sigma2[k, c] = ratio * sigma2


@kernel(_nrt=False)
def _left_of_locking(row, used, column):
    """Return the share of the variance of whole pixels that smoothing leaves where rows slope.

    The mean of a sine over a share w of its period has sin(x) / x of it, with x = pi w. One over
    the square of that is 1 + x^2 / 3 + x^4 / 15, to this order.
    """
    c = np.uintp(column)
    reach = np.uintp(0.5 * used[c])
    way = row[min(c + reach, np.uintp(row.size - 1))] - row[c - min(reach, c)]
    x2 = (np.pi * way) ** 2
    return 1.0 if np.isnan(way) else 1.0 / (1.0 + x2 / 3.0 + x2 * x2 / 15.0)


@kernel
def _share_at(row, locking2):
    """Return the variance of whole pixels at a ``row`` over its mean ``locking2``.

    A line in the middle of a pixel, or between two, is off by nothing: the error is a sine, whose
    amplitude is how far off the row may be itself.
    """
    share = np.exp(-16.0 * np.pi**2 * locking2) * np.cos(4.0 * np.pi * row)
    return 1.0 if np.isnan(share) else 1.0 - share


@kernel(_nrt=False)
def _learned_variance(learned, rows, block, step_px):
    """Return the variance that ``learned`` rows near a block share: they differ from means alike.

    A line at rest shows its footprint at one place in a pixel alone, which draws the rows. Means of
    a line that moves by ``step_px`` from profile to profile may lag by that.
    """
    total, squares, number = 0.0, 0.0, 0.0
    begin, end = max((block - 2) * BLOCK_COLUMNS, 0), (block + 1) * BLOCK_COLUMNS
    for c in range(np.uintp(begin), np.uintp(min(end, rows.row.shape[1]))):
        mean = _mean(rows.events[0, c], rows.windows.first[0, c], rows.windows.d[0, c])
        apart = learned[c] - mean
        if apart * apart <= _PIXEL2 and not rows.truncated[0, c]:
            total += apart
            squares += apart * apart
            number += 1.0
    if number == 0.0:
        return 0.0
    together = total / number
    chance2 = (squares / number - together * together) / number
    return max(max(abs(together) - step_px, 0.0) ** 2 - chance2, 0.0)


@kernel(_nrt=False)
def _scale_smoothed(rows, scatter, smoothing, windowed, step_px, learned):
    """Scale the smoothed variances of a profile by the scatter left, as `_scale` does.

    They are no less than what all columns may share, which is in the scatter where the rows differ.
    Rows may be ``learned``; the line moves by ``step_px``, by block, from profile to profile.
    """
    returns, columns = rows.row.shape
    near, far, sigma2 = scatter.near, scatter.far, smoothing.sigma2
    row, used = smoothing.row[0], smoothing.used[0]
    _add_smoothed_differences(row, sigma2[0], used, rows.sigma2[0], _NEAR_APART, near)
    _add_smoothed_differences(row, sigma2[0], used, rows.sigma2[0], _FAR_APART, far)
    for block in range(1, near.number.size - 1):
        ratio = _smoothed_ratio(scatter, block) if windowed else -1.0
        factor = ratio if ratio >= 0.0 else 1.0
        begin, end = (block - 1) * BLOCK_COLUMNS, min(block * BLOCK_COLUMNS, columns)
        learned2 = _learned_variance(rows.row[0], rows, block, step_px[block]) if learned else 0.0
        for k in range(returns):
            middle, locking2 = np.uintp((begin + end) // 2), scatter.levels.variance[block]
            locking2 *= _left_of_locking(smoothing.row[k], smoothing.used[k], middle)
            locking2 *= _share_at(smoothing.row[k, middle], locking2)
            for c in range(np.uintp(begin), np.uintp(end)):
                rows.common2[k, c] += 0.0 if rows.truncated[k, c] else locking2 + learned2
                own2, common2 = factor * sigma2[k, c], rows.common2[k, c]
                sigma2[k, c] = max(common2, own2) if ratio >= 0.0 else common2 + own2
