"""The error model of a row, by estimator.

A row's variance has two parts. Its own, which smoothing over columns lessens::

    a^2 min(s^2, s0^2) / N + floor^2 + b^2 (s^2 - s0^2) / N

with s the standard deviation of the N rows used and s0 that of the line itself. The first term is
small because counts per pixel and laser edge vary far less than Poisson counts; the floor comes
from the mismatch of the pixels' thresholds, which more events of the same pixels do not lessen;
the last is for events beyond the line's own, which scatter independently. And the part that
neighbouring columns share::

    common^2 + motion^2 * way of the line since the last profile + (jump * that way)^2
             + (clipped * rows missing to the line's full width)^2

The last is for footprints that an edge of the scene clips; a dark surface looks narrow, too, and
gets a larger sigma than it deserves. The constants are fitted to the simulated scenes of the
report's sigma experiment, at 70, 300 and 1000 Hz; `sigma_factor`, `sigma_floor_px` and
`sigma_common_px` adapt them to an instrument.
"""

from __future__ import annotations

from dataclasses import dataclass

from eschorty_ros.core.base.arrays import number
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.line._sigma import Noise

SIGMA_FACTOR = 0.05
SIGMA_FLOOR_PX = 0.28
SIGMA_COMMON_PX = 0.045
SIGMA_LIMIT = 1e6

# A line of evenly lit rows, with soft ends: variance over its full width at half maximum squared.
OWN_PER_WIDTH2 = 1.25 / 12.0
CLIPPED = 0.6


@dataclass(frozen=True, slots=True)
class _MethodNoise:
    """An estimator's multiples of factor and floor, its ``b``, and its share of the motion."""

    factor: float
    floor: float
    background: float
    motion: float


METHOD_NOISE = {
    "mode_mean": _MethodNoise(0.2, 0.89, 0.4, 0.20),
    "mean": _MethodNoise(0.4, 0.672, 1.0, 0.18),
    "median": _MethodNoise(0.2, 0.935, 1.48, 0.11),
    "gauss_ml": _MethodNoise(0.2, 0.91, 0.4, 0.20),
    "edge_mid": _MethodNoise(0.243, 0.885, 0.42, 0.18),
}


def noise_of(
    method: str,
    sigma_factor: float = SIGMA_FACTOR,
    sigma_floor_px: float = SIGMA_FLOOR_PX,
    sigma_common_px: float = SIGMA_COMMON_PX,
    clipped: float = CLIPPED,
) -> Noise:
    """Error model of an estimator for the kernels.

    Parameters
    ----------
    method : str
        One of ``centroid.METHODS``.
    sigma_factor : float
        Factor ``a`` on s/sqrt(N).
    sigma_floor_px : float
        Part of a column's standard deviation that more events do not lessen.
    sigma_common_px : float
        Part that neighbouring columns share and smoothing does not lessen.

    clipped : float
        Standard deviation over the rows missing to the line's full width.

    Raises
    ------
    ArgumentError
        When there is no such method or a value is negative or not finite.
    """
    if not isinstance(method, str) or method not in METHOD_NOISE:
        raise ArgumentError(f"method is {method!r}; choose one of {', '.join(METHOD_NOISE)}")
    own = METHOD_NOISE[method]
    return Noise(
        factor=own.factor * number("sigma_factor", sigma_factor, 0.0, SIGMA_LIMIT),
        floor=own.floor * number("sigma_floor_px", sigma_floor_px, 0.0, SIGMA_LIMIT),
        common=number("sigma_common_px", sigma_common_px, 0.0, SIGMA_LIMIT),
        motion=own.motion,
        background=own.background,
        clipped=number("clipped", clipped, 0.0, SIGMA_LIMIT),
        median=method == "median",
    )
