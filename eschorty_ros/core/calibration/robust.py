"""Targets that follow one curve: least median of squares, then Cauchy's loss, then a cut."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import FitError
from eschorty_ros.core.base.numbers import SIGMA_PER_MAD
from eschorty_ros.core.calibration.fit import refuse_singular, search
from eschorty_ros.core.calibration.residuals import (
    Observed,
    Problem,
    Values,
    condition_number,
    covariance,
    values_of,
)
from eschorty_ros.core.optics import RangeModel

Mask = NDArray[np.bool_]

_CUT_SIGMA = 4.0
# Beyond this many times the stated sigmas the targets contradict each other.
SCALE_MAX = 10.0
# 95 % efficiency on Gaussian errors.
_CAUCHY = 2.385
_ITERATIONS = 15
_SCALE_CONVERGED = 1e-3
_PAIRED_MAX = 40


def inliers(
    observed: Observed, design: RangeModel, names: tuple[str, ...], priors: Mapping[str, float]
) -> tuple[Mask, Array]:
    """Return a mask of the targets that follow one curve, and the residuals of all against it.

    Residuals are in standard deviations; those of the others include the uncertainty of the curve.
    Raises ``FitError`` when no curve fits more than half of the targets.
    """
    values = _least_median(observed, design)
    refuse_singular(Problem(observed, design, names, priors, values), values)
    before = 0.0
    for _ in range(_ITERATIONS):
        problem = Problem(observed, design, names, priors, values)
        # By the rows: widths depend on k and the width bias, which the first line does not fit.
        scale = _scale(problem.whitened(values)[:, :1], observed.known[:, :1])
        if abs(scale - before) < _SCALE_CONVERGED * scale:
            break
        values, before = search(problem, values, cauchy_scale=_CAUCHY * scale), scale
    return _cut(observed, design, names, priors, values)


def _least_median(observed: Observed, design: RangeModel) -> Values:
    """Return the line through two targets with the least median residual, k and b as designed."""
    x = 1.0 / (observed.range_mm + design.b_mm)
    rows, sigma = observed.measured[:, 0], observed.sigma[:, 0]
    sigma = np.hypot(sigma, design.product_mm_px * x * x * observed.sigma_range_mm)
    chosen = np.argsort(x, kind="stable")
    if chosen.size > _PAIRED_MAX:
        chosen = chosen[np.linspace(0, chosen.size - 1, _PAIRED_MAX).astype(np.intp)]
    one, other = (chosen[side] for side in np.triu_indices(chosen.size, 1))
    apart = x[one] != x[other]
    one, other = one[apart], other[apart]
    product = (rows[one] - rows[other]) / (x[one] - x[other])
    offset = product * x[one] - rows[one]
    possible = (product < 0.0) & (offset <= -1.0)
    if not possible.any():
        raise FitError(
            "no two targets show rows that grow with range (condition number inf); check row and "
            "range_mm"
        )
    product, offset = product[possible], offset[possible]
    residual = np.abs(product[:, None] * x - offset[:, None] - rows) / sigma
    middle = (rows.size + 3) // 2
    median = np.partition(residual, middle - 1, axis=1)[:, middle - 1]
    best = int(np.argmin(median))
    return values_of(design) | {
        "k_prime_px": float(product[best] / design.k_mm),
        "b_prime_px": float(offset[best]),
    }


def _cut(
    observed: Observed,
    design: RangeModel,
    names: tuple[str, ...],
    priors: Mapping[str, float],
    values: Values,
) -> tuple[Mask, Array]:
    """Refit the targets within the cut until they are the same ones; return as `inliers`."""
    every = Problem(observed, design, names, priors, values)
    distance = every.whitened(values)
    kept = np.zeros(len(observed), dtype=bool)
    for _ in range(_ITERATIONS):
        # Once the outliers are out they no longer widen the cut.
        better = observed.known & kept[:, None] if kept.any() else observed.known
        scale = _scale(distance, better)
        before, kept = kept, np.abs(distance).max(axis=1) <= _CUT_SIGMA * scale
        _refuse_contradictions(kept, scale, observed, names, _check(distance, observed.known))
        if np.array_equal(kept, before):
            break
        part = Problem(observed.select(kept), design, names, priors, values)
        refuse_singular(part, values)
        values = search(part, values)
        every = Problem(observed, design, names, priors, values)
        distance = every.whitened(values)
        jacobian = part.jacobian(part.free(values))
        if np.isfinite(condition_number(jacobian)):
            own = np.einsum("nii->ni", every.leverage(values, covariance(jacobian)))
            distance = np.where(kept[:, None], distance, distance / np.sqrt(1.0 + own))
    return kept, distance


def _scale(distance: Array, known: Mask) -> float:
    """Return how much larger the better half's residuals are than stated; at least 1."""
    return max(1.0, SIGMA_PER_MAD * float(np.median(np.abs(distance[known]))))


def _check(distance: Array, known: Mask) -> str:
    """Return what to check: that of the channel with the largest median residual."""
    medians = [
        float(np.median(np.abs(distance[used, channel]))) if used.any() else 0.0
        for channel, used in enumerate(known.T)
    ]
    return (
        "ranges, which target is which and sigma_row_px, or fit b_prime_1_px, too, where the "
        "sensor is rolled",
        "width_px and size_mm",
        "spacing_px and spacing_mm",
    )[int(np.argmax(medians))]


def contradicted(names: tuple[str, ...]) -> str:
    """Return what targets contradict that are far from every curve with these free parameters."""
    if {"k_prime_px", "b_prime_px"} <= set(names):
        return "each other"
    return f"each other, or the design, of which {', '.join(names)} alone is free"


def _refuse_contradictions(
    kept: Mask, scale: float, observed: Observed, names: tuple[str, ...], check: str
) -> None:
    if scale > SCALE_MAX:
        raise FitError(
            f"the targets contradict {contradicted(names)}: even the better half is {scale:.0f} "
            f"times farther from any curve than their sigmas allow; check {check}"
        )
    if 2 * int(kept.sum()) <= len(observed) or np.ptp(observed.range_mm[kept]) == 0.0:
        raise FitError(
            f"only {int(kept.sum())} of {len(observed)} targets follow one curve; check {check}"
        )
