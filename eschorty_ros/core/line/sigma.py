"""Error model of a row, by estimator.

The variance of a row has two parts. The column's own is reduced by smoothing over columns::

    a^2 min(s^2, s0^2) / N + floor^2 + b^2 (s^2 - s0^2) / N

with s the standard deviation of the N rows used and s0 that of the line itself. The first term is
for events that are independent (a = 1). Those of pixels are not: counts per pixel and laser edge
vary far less than Poisson counts. The floor comes from the mismatch of the pixels' thresholds,
which more events of the same pixels do not reduce. The last term is for events of full columns that
are not the line's; most of them are on one side of a line away from the sensor's middle, so that a
part of their error is common. That of the median follows from the distance of the line's events.
The other part is what neighbouring columns share (`line_history`).

The floor and b are fitted to the simulated scenes of the report's sigma experiment, at 70, 300 and
1000 Hz. In a stream the own part of windowed estimators is scaled by the scatter of near columns
(`scatter`), so that the floor matters only where few differences near a column are known; there the
variance of independent events is added.
"""

from __future__ import annotations

from typing import NamedTuple

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.base.numbers import number

SIGMA_FLOOR_PX = 0.25
_SIGMA_LIMIT = 1e6
# Variance of a line of evenly lit rows with soft ends over its full width at half maximum squared.
VARIANCE_PER_WIDTH2 = 1.25 / 12.0
BACKGROUND_FACTORS = {"mean": 1.5, "median": 2.7}
"""The factor b of each method that uses full columns."""


class ErrorModel(NamedTuple):
    """Coefficients of the variance of a row, mean or ``median``: a, the floor in rows, and b."""

    factor: float
    floor: float
    background: float
    median: bool = False


def error_model(method: str, sigma_factor: float, sigma_floor_px: float) -> ErrorModel:
    """Return the error model of an estimator.

    Raises ``ArgumentError`` when a value is negative or not finite.
    """
    return ErrorModel(
        factor=number("sigma_factor", sigma_factor, 0.0, _SIGMA_LIMIT),
        floor=number("sigma_floor_px", sigma_floor_px, 0.0, _SIGMA_LIMIT),
        background=BACKGROUND_FACTORS.get(method, 0.0),
        median=method == "median",
    )


@kernel(forceinline=True)
def _background(excess, count, row, sensor_rows):
    """Return the number of background events, evenly spread, that explain ``excess`` variance.

    The second value is the share of their mean square distance that is common to all, as most of
    them are on one side of a line away from the sensor's middle.
    """
    offset = 0.5 * (sensor_rows - 1.0) - row
    square = sensor_rows * sensor_rows / 12.0 + offset * offset
    return excess * count / square, offset * offset / square


@kernel(forceinline=True)
def _own_variance(variance, line_variance, count, row, sensor_rows, model):
    """Return the variance of one column's row, px squared, without what its neighbours share.

    Variance in excess of ``line_variance`` comes from background events. Without any spread the row
    has the variance of its quantisation, a twelfth.
    """
    floor2 = model.floor**2
    sigma2 = model.factor**2 * min(variance, line_variance) / count + floor2
    # No branch: whether a line is wider than expected is a matter of chance.
    excess = max(variance - line_variance, 0.0)
    events, shared = _background(excess, count, row, sensor_rows)
    coherent = 1.0 + max(events - 1.0, 0.0) * shared
    if model.median:
        # A background event moves the median by half the distance of two of the line's events.
        step2 = 3.0 * line_variance / (count * count)
        sigma2 += model.background**2 * events * coherent * step2
    else:
        sigma2 += model.background**2 * excess / count * coherent
    least = 1.0 / 12.0 + floor2 if (count < 2) | (variance == 0.0) else 0.0
    return max(sigma2, least)
