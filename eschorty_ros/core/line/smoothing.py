"""Smoothing of a profile over its columns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import number, reals, whole
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.line._smoothing import Smoothing, _smooth


def smooth(
    row: NDArray[np.float64],
    sigma_row: NDArray[np.float64],
    half_width: int = 2,
    gate_px: float = 2.0,
    common_px: float = 0.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average each column with symmetric pairs of neighbours.

    Parameters
    ----------
    row, sigma_row : ndarray of float64, shape (columns,)
        NaN where a column is not lit.
    half_width : int
        Pairs at most; 0 returns copies.
    gate_px : float
        Both columns of a pair must be lit and this close in rows to the centre; the first pair
        that is not ends the average.
    common_px : float
        Part of every ``sigma_row`` that neighbours share, at most the smallest of them.

    Returns
    -------
    row, sigma_row : ndarray of float64, shape (columns,)

    Notes
    -----
    Pairs leave a linear slope as it is. No average reaches across a step larger than the gate and
    no dark column is filled. Beyond the common part the columns' errors are independent, so the
    variance of the mean of n columns is the sum of theirs over n squared. The common part stays:
    neighbours on a flat surface meet the pixel rows at the same place, and so does their error.

    Raises
    ------
    ArgumentError
        When shapes differ, or a parameter is negative.
    """
    rows = np.ascontiguousarray(reals("row", row))
    sigma = np.ascontiguousarray(reals("sigma_row", sigma_row))
    if rows.ndim != 1 or rows.shape != sigma.shape:
        raise ArgumentError(
            f"row has shape {rows.shape} and sigma_row {sigma.shape}; give two equal axes"
        )
    if (sigma < 0.0).any():
        raise ArgumentError(f"sigma_row is {np.nanmin(sigma)}; choose 0 or more")
    whole("half_width", half_width, 0, 1 << 31)
    number("gate_px", gate_px, 0.0)
    number("common_px", common_px, 0.0)
    out_row, out_sigma2 = np.empty((2, 1, rows.size))
    own2 = np.maximum(sigma * sigma - common_px * common_px, 0.0)
    common2 = sigma * sigma - own2
    none = np.zeros((1, rows.size), np.bool_)
    settings = Smoothing(half_width, float(gate_px), 0.0, 0, none, out_row, out_sigma2)
    _smooth(rows[None], own2[None], common2[None], settings)
    return out_row[0], np.sqrt(out_sigma2[0])
