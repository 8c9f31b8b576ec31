"""The modulation period of each point of a cloud, from the points alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError

# Largest difference of the mean times of two returns of one period, as a share of the period.
RETURNS_APART = 0.2
_SHORTEST_S = 1e-7
_PERIODS_MAX = 1e12


def period_s(points: NDArray[np.void]) -> float:
    """Return the modulation period of a cloud in seconds, NaN when no column has two points.

    The times between a column's points are multiples of the period, mostly one period, and give a
    first estimate; straight-line fits over doubling spans refine it. Two returns of one period are
    a small part of it apart and are left out of the first estimate.

    - ``points``: POINT_DTYPE.
    """
    order = np.lexsort((points["t"], points["column"]))
    t_s = points["t"][order]
    same = np.diff(points["column"][order].astype(np.int64)) == 0
    gaps = np.diff(t_s)[same]
    gaps = gaps[gaps > _SHORTEST_S]
    if gaps.size == 0:
        return float("nan")
    gaps = gaps[gaps > RETURNS_APART * np.quantile(gaps, 0.75)]
    first = float(np.median(gaps))
    period = float(gaps.sum() / np.maximum(np.rint(gaps / first), 1.0).sum())
    elapsed = np.sort(points["t"]) - points["t"].min()
    elapsed -= _phase(elapsed[elapsed <= 16.0 * period] / period) * period
    span = 16.0 * period
    while True:
        part = elapsed[elapsed <= span]
        index = np.rint(part / period)
        if index[-1] > index[0]:
            period = float(np.polyfit(index, part, 1)[0])
        if span > elapsed[-1]:
            return period
        span *= 2.0


def profile_begins(columns: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
    """Return where the profiles of points in the order of time begin.

    The columns of a profile are in order, so that the next begins where they fall.

    - ``columns``: Column of each point, shape (n,).
    """
    return np.flatnonzero(np.diff(columns.astype(np.int64), prepend=1 << 32) < 0)


def profile_index(points: NDArray[np.void], period: float) -> NDArray[np.int64]:
    """Return the number of every point's modulation period, the first being 0.

    - ``points``: POINT_DTYPE, shape (n,).
    - ``period``: Modulation period, seconds.

    Raises ``ArgumentError`` when the period is not positive.
    """
    if not period > 0.0:
        raise ArgumentError(f"period is {period!r} s; give a positive modulation period")
    if len(points) == 0:
        return np.empty(0, np.int64)
    turns = (points["t"] - points["t"].min()) / period
    if not turns.max() < _PERIODS_MAX:
        raise ArgumentError(
            f"the cloud spans {turns.max():.3g} periods of {period:.3g} s; give one with times "
            f"within {_PERIODS_MAX:g} periods"
        )
    index = np.rint(turns - _phase(turns)).astype(np.int64)
    return index - index.min()


def _phase(turns: NDArray[np.float64]) -> float:
    """Return the circular mean of the fractional part, -0.5 to 0.5."""
    return float(np.angle(np.mean(np.exp(2j * np.pi * turns)))) / (2.0 * np.pi)
