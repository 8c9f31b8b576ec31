"""Estimators of a column's row: their names and settings, mean and median."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.sigma import BACKGROUND_FACTORS, ErrorModel
from eschorty_ros.core.line.window import FRACTION, HALF_WIDTH_PER_FWHM, ROW_LAST, ROW_MASK

METHODS = ("mode_mean", "mean", "median")
CENTROIDS = (*METHODS, "learned")
"""The methods, and the one that follows a stream."""
FULL_COLUMN_METHODS = tuple(BACKGROUND_FACTORS)
RETURNS = ("strongest", "first", "last", "all")

# Codes are indices of the tuples above.
_MODE_MEAN, _MEDIAN, _LEARNED = map(CENTROIDS.index, ("mode_mean", "median", "learned"))
_FULL_COLUMN = tuple(map(CENTROIDS.index, FULL_COLUMN_METHODS))
_STRONGEST, _LAST, _ALL = map(RETURNS.index, ("strongest", "last", "all"))

FWHM_PER_SIGMA = 2.3548200450309493
# Least half width of a window, fixed point.
HALF_MIN = 3 * FRACTION
# A window's half width in standard deviations of the line, fixed point.
HALF_PER_SIGMA = HALF_WIDTH_PER_FWHM * FWHM_PER_SIGMA * FRACTION


class Estimator(NamedTuple):
    """Settings of an estimator.

    ``half_max`` is the half width of a window for the widest line, fixed point, and
    ``line_variance`` the variance of its rows. With ``seeded`` the search begins at the column's
    last row, or at its neighbour's. Columns take events of ``rows_taken`` rows, fewer than the
    ``sensor_rows`` in a region of interest.
    """

    method: int
    returns: int
    seeded: bool
    events_min: int
    sensor_rows: int
    rows_taken: int
    half_max: int
    line_variance: float
    error_model: ErrorModel


def half_width_fixed(fwhm_px: float) -> int:
    """Return the half width of the averaging window for a line of ``fwhm_px``, fixed point."""
    return max(round(HALF_WIDTH_PER_FWHM * fwhm_px * FRACTION), HALF_MIN)


def check_method(method: str, returns: str = "strongest") -> tuple[int, int]:
    """Return the codes of a method and of the returns it reports.

    Raises ``ArgumentError`` when there is no such method or choice of returns, or the method does
    not separate returns.
    """
    if not isinstance(method, str) or method not in CENTROIDS:
        raise ArgumentError(f"centroid is {method!r}; choose one of {', '.join(CENTROIDS)}")
    if not isinstance(returns, str) or returns not in RETURNS:
        raise ArgumentError(f"returns is {returns!r}; choose one of {', '.join(RETURNS)}")
    if method in FULL_COLUMN_METHODS and returns != "strongest":
        windowed = [name for name in CENTROIDS if name not in FULL_COLUMN_METHODS]
        raise ArgumentError(
            f"returns is {returns!r} and {method!r} averages the full column; choose 'strongest', "
            f"or one of {', '.join(windowed)} as centroid"
        )
    return CENTROIDS.index(method), RETURNS.index(returns)


@kernel
def _is_windowed(method):
    return method not in _FULL_COLUMN


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
def _median(column, counts):
    """Return the middle row, or the mean of the two middle rows; ``counts`` is zeroed scratch."""
    n = column.events
    low = np.int64(ROW_LAST)
    high = np.int64(0)
    for i in range(column.start, column.start + n):
        row = np.int64(column.packed[i] & ROW_MASK)
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
