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

_APART = 5
# Columns of a block; the differences of a block and its two neighbours count for its points. The
# share of a profile's differences that the next keeps.
_BLOCK = 16
_KEPT = 0.5
_DIFFERENCES_MIN = 8.0
# A larger second difference is an edge of the surface, but where most are as large.
_DIFFERENCE_MAX_PX = 4.0
_DEVIATIONS_MAX = 3.0
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
    usual = np.sqrt(scatter.squares.sum() / max(scatter.number.sum(), 1.0))
    largest = max(_DIFFERENCE_MAX_PX, _DEVIATIONS_MAX * usual)
    for block in range(1, scatter.number.size - 1):
        first = max((block - 1) * _BLOCK, _APART)
        last = min(block * _BLOCK, columns - _APART)
        squares, expected, number = 0.0, 0.0, 0.0
        for c in range(np.uintp(first), np.uintp(max(first, last))):
            before, after = c - np.uintp(_APART), c + np.uintp(_APART)
            difference = row[before] - 2.0 * row[c] + row[after]
            whole = not (cut[before] | cut[c] | cut[after])
            if whole & (abs(difference) <= largest):
                squares += difference * difference
                expected += sigma2[before] + 4.0 * sigma2[c] + sigma2[after]
                number += 1.0
        scatter.squares[block] = _KEPT * scatter.squares[block] + squares
        scatter.expected[block] = _KEPT * scatter.expected[block] + expected
        scatter.number[block] = _KEPT * scatter.number[block] + number


@kernel(_nrt=False)
def _scale(rows, scatter, smoothing):
    """Scale the variances of a profile by the scatter, and widen the smoothing gates by it.

    With a ``factor_max`` of 0, for means over full columns, they are as expected.
    """
    returns, columns = rows.row.shape
    _add_differences(rows, scatter)
    for block in range(1, scatter.number.size - 1):
        near = slice(block - 1, block + 2)
        measured = scatter.number[near].sum() >= _DIFFERENCES_MIN and scatter.factor_max > 0.0
        ratio = scatter.squares[near].sum() / scatter.expected[near].sum() if measured else 1.0
        ratio = min(ratio, FACTOR_MAX)
        factor = min(ratio, scatter.factor_max) if measured else 1.0
        for k in range(returns):
            for c in range(np.uintp((block - 1) * _BLOCK), np.uintp(min(block * _BLOCK, columns))):
                sigma2, cut = rows.sigma2[k, c], rows.truncated[k, c]
                scattered = _DEVIATIONS_MAX * np.sqrt(2.0 * ratio * sigma2)
                gate_px = max(smoothing.gate_px, scattered)
                smoothing.gates_px[k, c] = smoothing.gate_px if cut else gate_px
                own2 = sigma2 if cut else factor * sigma2
                rows.sigma2[k, c] = own2
                rows.common2[k, c] += max(_LOCKING - own2, 0.0) if measured and not cut else 0.0
