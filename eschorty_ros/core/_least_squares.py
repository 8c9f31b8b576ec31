"""Small dense least squares on scaled columns: condition, covariance, damped Gauss-Newton.

Everything goes through the singular values of a Jacobian whose columns have unit length, so
parameters may differ in unit by any factor and no condition number is ever squared.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Residual = Callable[[Array], "Array | None"]
Jacobian = Callable[[Array], Array]

RANK_TOLERANCE = 1e-12
_ITERATIONS_MAX = 200
# A step that moves the fitted values by less than this share of them is the last one.
_STEP_TOLERANCE = 1e-14
_DAMPING_START = 1e-3
_DAMPING_LIMIT = 1e12


def unit_columns(jacobian: Array) -> tuple[Array, Array]:
    """Columns divided by their lengths, and the lengths (1 for a column of zeros)."""
    length = np.linalg.norm(jacobian, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    return jacobian / length, length


def condition_number(jacobian: Array) -> float:
    """Largest over smallest singular value of the unit columns; infinite when rank is missing."""
    scaled, _ = unit_columns(jacobian)
    if scaled.shape[0] < scaled.shape[1]:
        return float("inf")
    singular = np.linalg.svd(scaled, compute_uv=False)
    if singular[-1] <= RANK_TOLERANCE * singular[0]:
        return float("inf")
    return float(singular[0] / singular[-1])


def covariance(jacobian: Array) -> Array:
    """``(J^T J)^-1`` of a Jacobian of full rank, without forming ``J^T J``."""
    scaled, length = unit_columns(jacobian)
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    root = right.T / singular / length[:, None]
    return np.asarray(root @ root.T)


def minimise(start: Array, residual: Residual, jacobian: Jacobian, size: float) -> Array | None:
    """Parameters that minimise the sum of squared residuals, by Levenberg's damping.

    ``residual`` gives ``None`` where the model has no value; such a step is shortened. ``size`` is
    the length of the vector of fitted values, against which steps count as small. ``None`` when
    the iterations do not end.
    """
    parameters = start
    now = residual(parameters)
    if now is None:
        return None
    # Near the minimum two lengths differ by what rounding the fitted values leaves.
    rounding = 8.0 * float(np.finfo(np.float64).eps) * size
    damping = 0.0
    for _ in range(_ITERATIONS_MAX):
        scaled, length = unit_columns(jacobian(parameters))
        left, singular, right = np.linalg.svd(scaled, full_matrices=False)
        if damping == 0.0 and singular[-1] <= RANK_TOLERANCE * singular[0]:
            damping = _DAMPING_START
        step = -(right.T @ (singular / (singular**2 + damping) * (left.T @ now)))
        last = damping == 0.0 and float(np.linalg.norm(scaled @ step)) <= _STEP_TOLERANCE * size
        trial = parameters + step / length
        after = residual(trial)
        better = after is not None and np.linalg.norm(after) <= np.linalg.norm(now) + rounding
        if last:
            return trial if better else parameters
        if after is not None and better:
            parameters, now = trial, after
            damping = damping / 10.0 if damping > 1e-9 else 0.0
        else:
            damping = max(10.0 * damping, _DAMPING_START)
            if damping > _DAMPING_LIMIT:
                return None
    return None
