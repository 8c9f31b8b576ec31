"""Sigma from the scatter at hand: how much rows of near columns differ, in this stream.

The second difference of the rows of three columns, five apart, is zero on a smooth surface, so its
mean square is six variances of a single row, less what all of them share. Its ratio to what the
estimator expects scales the expected variance.

Where rows hardly scatter, neighbours share an error instead: the two ends of the line are whole
pixels, a twelfth of a squared row each, and their middle has half of that. Scatter dithers it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.sigma import _motion_variance

_APART = 5
# Columns of a block; the differences of a block and its two neighbours count for its points. The
# share of a profile's differences that the next keeps.
_BLOCK = 16
_KEPT = 0.5
_DIFFERENCES_MIN = 8.0
# A larger second difference is an edge of the surface.
_DIFFERENCE_MAX_PX = 4.0
FACTOR_MAX = 64.0
_LOCKING = 1.0 / 24.0


class Scatter(NamedTuple):
    """Sums over profiles, by block: squared differences, what is expected, their number.

    Variances are scaled by ``factor_max`` at most.
    """

    squares: NDArray[np.float64]
    expected: NDArray[np.float64]
    number: NDArray[np.float64]
    factor_max: float


def empty_scatter(columns: int, factor_max: float) -> Scatter:
    """Return no differences; the first and the last block are outside the sensor."""
    squares, expected, number = np.zeros((3, -(-columns // _BLOCK) + 2))
    return Scatter(squares, expected, number, factor_max)


@kernel(_nrt=False)
def _add_differences(rows, scatter):
    """Add the second differences of a profile to the sums, but for lines that an edge cuts."""
    row, sigma2, cut = rows.row[0], rows.sigma2[0], rows.truncated[0]
    columns = row.size
    for block in range(1, scatter.number.size - 1):
        first = max((block - 1) * _BLOCK, _APART)
        last = min(block * _BLOCK, columns - _APART)
        squares, expected, number = 0.0, 0.0, 0.0
        for c in range(first, last):
            before, after = c - _APART, c + _APART
            difference = row[before] - 2.0 * row[c] + row[after]
            whole = not (cut[before] or cut[c] or cut[after])
            if whole and abs(difference) <= _DIFFERENCE_MAX_PX:
                squares += difference * difference
                expected += sigma2[before] + 4.0 * sigma2[c] + sigma2[after]
                number += 1.0
        scatter.squares[block] = _KEPT * scatter.squares[block] + squares
        scatter.expected[block] = _KEPT * scatter.expected[block] + expected
        scatter.number[block] = _KEPT * scatter.number[block] + number


@kernel(_nrt=False)
def _common_shift(shift, variance, first, last):
    """Return the mean way of the line in a block of columns, 0 where their scatter explains it."""
    total, number = 0.0, 0
    for c in range(first, last):
        if np.isfinite(shift[c]):
            total += shift[c]
            number += 1
    if number == 0 or total * total <= 8.0 * variance * number:
        return 0.0
    return total / number


@kernel(_nrt=False)
def _scale(rows, scatter, model):
    """Scale the variances of a profile by the scatter, and add that of the line's motion.

    With a ``factor_max`` of 0, for means over full columns, they are as expected, and every column
    moves by itself.
    """
    returns, columns = rows.row.shape
    _add_differences(rows, scatter)
    for block in range(1, scatter.number.size - 1):
        near = slice(block - 1, block + 2)
        number = scatter.number[near].sum()
        known = number >= _DIFFERENCES_MIN and scatter.factor_max > 0.0
        factor, variance = 1.0, 0.0
        if known:
            squares = scatter.squares[near].sum()
            factor = min(squares / scatter.expected[near].sum(), scatter.factor_max)
            variance = squares / (6.0 * number)
        first, last = (block - 1) * _BLOCK, min(block * _BLOCK, columns)
        together = _common_shift(rows.shift, variance, first, last)
        if scatter.factor_max == 0.0:
            together = 0.0
        motion2 = _motion_variance(together, model)
        for k in range(returns):
            for c in range(first, last):
                scaled = known and not rows.truncated[k, c]
                own2 = (factor if scaled else 1.0) * rows.sigma2[k, c]
                common2 = rows.common2[k, c] + motion2
                if scaled and own2 < _LOCKING:
                    common2 += _LOCKING - own2
                # Alone a column's shift counts only beyond what its own scatter explains.
                alone = rows.shift[c]
                explained2 = 18.0 * max(own2, variance) if scatter.factor_max > 0.0 else 0.0
                if alone * alone > explained2 and abs(alone) > abs(together):
                    common2 += _motion_variance(alone, model) - motion2
                rows.sigma2[k, c] = own2
                rows.common2[k, c] = common2
