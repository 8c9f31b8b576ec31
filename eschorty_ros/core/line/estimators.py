"""Row of the line from the events of a window or a column: mean and median."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.window import FRACTION, HALF_WIDTH_PER_FWHM, ROW_LAST, ROW_MASK

FWHM_PER_SIGMA = 2.3548200450309493
# Least half width of a window, fixed point.
HALF_MIN = 3 * FRACTION
# A window's half width in standard deviations of the line, fixed point.
HALF_PER_SIGMA = HALF_WIDTH_PER_FWHM * FWHM_PER_SIGMA * FRACTION


@kernel(forceinline=True)
def _mean(events, first, d):
    """Return the mean row of events, NaN of none; ``d`` is their sum, relative to row ``first``."""
    return (events * first + d) / events if events > 0 else np.nan


@kernel(forceinline=True)
def _variance(events, d, d2):
    """Return the sample variance, NaN of none; of rows that are all the same it is exactly 0."""
    squares = events * d2 - d * d
    return squares / max(float(events) * (events - 1), 1.0) if events > 0 else np.nan


@kernel(_nrt=False)
def _median(packed, column, counts):
    """Return the middle row, or the mean of the two middle rows; ``counts`` is zeroed scratch."""
    n = column.events
    low = np.int64(ROW_LAST)
    high = np.int64(0)
    for i in range(column.start, column.start + n):
        row = np.int64(packed[i] & ROW_MASK)
        counts[row] += 1
        low = min(low, row)
        high = max(high, row)
    below = np.int64(0)
    lower = np.int64(-1)
    upper = np.int64(-1)
    for middle in range(low, high + 1):
        row = np.int64(middle)
        below += counts[row]
        counts[row] = 0
        if lower < 0 and 2 * below >= n:
            lower = np.int64(row)
        if upper < 0 and 2 * below > n:
            upper = np.int64(row)
    return (lower + upper) / 2.0
