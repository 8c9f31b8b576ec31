"""Pixel locking: the error that the rows of all columns share as the line's ends are whole pixels.

No difference of rows shows it, but the line does. Each end is off by a twelfth of a squared row,
the middle of two by that less a quarter of the variance of the length between them. Scatter of the
ends dithers it. Pixels with more events than one at either edge of the laser have more levels of
light that they count. Each level has ends of its own, and so have ON and OFF events where their
rows differ. The row is the mean of all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blocks import _near_sum

# Variance of a whole pixel.
_WHOLE = 1.0 / 12.0
# Mean square of a normal distribution over that of its mean size.
_SQUARE_PER_SIZE2 = 0.5 * np.pi


class LineEnds(NamedTuple):
    """Sums by block of what differences show of the ends of lines.

    ``sizes`` are those of differences of rows, ``lengths2`` variances of the length of a line.
    """

    sizes: NDArray[np.float64]
    lengths2: NDArray[np.float64]


@kernel(_nrt=False)
def _levels(rows, begin, end, laser_edges):
    """Return the mean number of levels that the pixels of columns count at an edge of the laser.

    Each level needs two ends of its own, so there are at most half as many as lit rows.
    """
    events, length, number = 0.0, 0.0, 0.0
    for k in range(rows.row.shape[0]):
        for c in range(np.uintp(begin), np.uintp(end)):
            found = not np.isnan(rows.row[k, c])
            events += rows.events[k, c] if found else 0.0
            length += np.sqrt(rows.variance[k, c] / _WHOLE) if found else 0.0
            number += 1.0 if found else 0.0
    levels = events / (laser_edges * max(length, 1.0))
    return max(min(levels, 0.5 * length / max(number, 1.0)), 1.0)


@kernel(_nrt=False)
def _polarity_variance(polarities, block):
    """Return the variance of the difference of ON from OFF rows near a block, 0 if not known."""
    total, compared = 0.0, 0
    for other in range(block - 1, block + 2):
        total += polarities.apart2[other] - polarities.apart[other] ** 2
        compared += polarities.all_columns[other] > 0.0
    return total / max(compared, 1)


@kernel(_nrt=False)
def _pixel_locking_variance(ends, number, block, levels, apart2):
    """Return the variance that rows near a block share as the line's ends are whole pixels.

    ``ends`` has the sums of ``number`` differences. A row is the mean of two ends for each of the
    levels, so that an end scatters by two of its variances for each. These follow from the mean
    size of differences: rows that leap to the next pixel are no scatter. Scatter dithers the first
    harmonic of an end's error. Rows of ON and OFF events that differ by the variance ``apart2``,
    four times that of their mean where they are independent, have levels of their own.
    """
    near = _near_sum(number, block)
    size = _near_sum(ends.sizes, block) / near
    row2 = _SQUARE_PER_SIZE2 * size * size / 6.0
    levels *= 1.0 + (min(0.25 * apart2 / row2, 1.0) if row2 > 0.0 else 0.0)
    end2 = 2.0 * levels * row2
    middle2 = max(_WHOLE - 0.25 * _near_sum(ends.lengths2, block) / near, 0.0)
    return middle2 / levels * np.exp(-((2.0 * np.pi) ** 2) * end2)
