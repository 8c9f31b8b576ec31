"""Condition number and covariance of a small dense Jacobian.

Everything goes through the singular values of a Jacobian whose columns have unit length, so
parameters may differ in unit by any factor and no condition number is ever squared.
"""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.arrays import Array

RANK_TOLERANCE = 1e-12


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
