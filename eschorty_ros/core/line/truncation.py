"""Row of a line that the sensor's first or last row truncates, from the truncated normal."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.estimators import HALF_PER_SIGMA, _mean
from eschorty_ros.core.line.sigma import _own_variance
from eschorty_ros.core.line.window import FRACTION

_ITERATIONS = 30
# Relative variance of a flat line's sample variance, times its count. A truncated line whose
# variance is one such standard deviation below the expected one is narrower than the window's.
_SCATTER = 1.0
# A column with more than this many times the line's variance holds background.
_BACKGROUND_FREE = 2.0
# Square of the least factor on s/sqrt(N): a fit to part of a line amplifies the scatter of counts.
_FACTOR2_MIN = 0.24**2
# Bias of the mean of half a Gaussian, squared, over the variance of that half.
_HALF_BIAS2 = 1.7519


class RowEstimate(NamedTuple):
    """A row and its variance; ``truncated`` where the edge of the sensor cuts the line."""

    row: float
    sigma2: float
    truncated: bool


class TruncatedFit(NamedTuple):
    """Centre and sigma of a Gaussian of which only the part beyond 0 is measured.

    ``ratio`` is the part's variance over sigma squared, ``moved`` the change of the centre due to
    fitting sigma.
    """

    centre: float
    sigma: float
    ratio: float
    moved: float


@kernel
def _newton_step(mean, centre, sigma):
    """Return Newton's next centre, 0 or more, of a Gaussian whose part beyond 0 has this mean.

    The second value is the part's variance over sigma squared.
    """
    alpha = -centre / sigma
    hazard = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * alpha * alpha) / math.erfc(alpha / np.sqrt(2.0))
    ratio = 1.0 + alpha * hazard - hazard * hazard
    return max(centre + (mean - centre - sigma * hazard) / ratio, 0.0), ratio


@kernel
def _fit_truncated(mean, variance, count, sigma_max):
    """Fit a Gaussian whose ``count`` events beyond 0 have this mean and variance.

    Sigma is ``sigma_max`` unless the variance is smaller than expected with it and at most a third
    of the line is cut away; then both are fitted. When more is cut away, centre and sigma cannot be
    separated. The centre is 0 or more. A part whose mean is more than 3 of its standard deviations
    from 0 is not truncated.
    """
    if mean > 3.0 * np.sqrt(variance):
        return TruncatedFit(mean, np.sqrt(variance), 1.0, 0.0)
    known = mean
    ratio = 1.0
    for _ in range(_ITERATIONS):
        known, ratio = _newton_step(mean, known, sigma_max)
    least = 1.0 - np.sqrt(_SCATTER / count)
    if known <= 0.5 * sigma_max or variance >= least * ratio * sigma_max * sigma_max:
        return TruncatedFit(known, sigma_max, ratio, 0.0)
    centre = known
    sigma = sigma_max
    for _ in range(_ITERATIONS):
        sigma = min(np.sqrt(variance / ratio), sigma_max)
        centre, ratio = _newton_step(mean, centre, sigma)
    return TruncatedFit(centre, sigma, ratio, centre - known)


@kernel
def _correct_truncation(row, sigma2, variance, window, half, rows, model):
    """Return the row of the full line where the edge of the sensor may cut the window.

    The line is assumed to be centred on the sensor. As real lines are flatter than a Gaussian,
    seven tenths of the correction count as its standard deviation, all of it when the centre is at
    the sensor's edge, plus half of the change due to fitting the line's width. The more is cut off,
    the more the counts scatter like independent ones.
    """
    count = window.sums.events
    reach = half / FRACTION
    mean = _mean(window)
    from_low = mean + 0.5
    from_high = rows - 0.5 - mean
    beyond = min(from_low, from_high)
    if beyond > reach or max(from_low, from_high) <= reach or variance == 0.0:
        return RowEstimate(row, sigma2, False)
    line = _fit_truncated(beyond, variance, count, reach * FRACTION / HALF_PER_SIGMA)
    shift = beyond - line.centre
    share = 1.0 if line.centre == 0.0 else 0.5
    factor2 = max(model.factor**2, _FACTOR2_MIN)
    scatter2 = factor2 + max(1.0 - factor2, 0.0) * (1.0 - line.ratio)
    wider2 = scatter2 * line.sigma**2 / (line.ratio * count) + model.floor**2
    wider2 += share * shift**2 + 0.25 * line.moved**2
    row = row - shift if from_low < from_high else row + shift
    # The correction of the mean may move a row from another estimator off the sensor.
    return RowEstimate(min(max(row, -0.5), rows - 0.5), max(sigma2, wider2), True)


@kernel
def _full_column_estimate(row, variance, line_variance, count, rows, model):
    """Return a row estimated from a full column, with a variance that covers its truncation."""
    sigma2 = _own_variance(variance, line_variance, count, row, rows, model)
    # Background widens a column without moving the line to the edge.
    line = min(variance, _BACKGROUND_FREE * line_variance)
    reach = 3.0 * np.sqrt(line)
    truncated = row < reach or rows - 1.0 - row < reach
    return RowEstimate(row, sigma2 + _HALF_BIAS2 * line if truncated else sigma2, truncated)
