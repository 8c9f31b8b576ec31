"""Fitting the range equation to targets at known ranges (Eq. 2).

Residuals are counted in rows: there the errors are, and a far target does not outweigh the near
ones. Sign conventions as in :class:`~eschorty_ros.core.optics.RangeModel`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core._calibration_solvers import (
    PARAMETERS,
    jacobian,
    row_jacobian,
    search,
    straight_line,
)
from eschorty_ros.core._checks import positive, reals, vector
from eschorty_ros.core._least_squares import condition_number, covariance
from eschorty_ros.core.errors import ArgumentError, FitError
from eschorty_ros.core.optics import RangeModel

Array = NDArray[np.float64]

PAPER_FREE = ("k_prime_px", "b_prime_px")
"""What the paper fits: k and b stay at their design values."""
CONDITION_WARNING = 1e3
_REWEIGHTINGS = 3


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFit:
    """What a set of targets says about a build.

    Attributes
    ----------
    model : RangeModel
        The fitted range equation.
    free : tuple of str
        Names of the fitted parameters, in the order of ``covariance``.
    covariance : ndarray of float64, shape (p, p)
        From the stated standard deviations of targets and priors, never from the residuals, so it
        also holds with no degrees of freedom left. Units of the parameters.
    residual_px : ndarray of float64, shape (n,)
        Row as measured minus row as fitted.
    sigma_px : ndarray of float64, shape (n,)
        Standard deviation of each residual: row and range error together.
    condition_number : float
        Of the Jacobian of targets and priors with columns of unit length.
    dof : int
        Targets plus priors minus free parameters.
    chi_square : float
        Sum of squared residuals of targets and priors over their standard deviations.
    verdicts : tuple of str
        One line for each reservation; empty when there is none.
    """

    model: RangeModel
    free: tuple[str, ...]
    covariance: Array
    residual_px: Array
    sigma_px: Array
    condition_number: float
    dof: int
    chi_square: float
    verdicts: tuple[str, ...]

    @property
    def reduced_chi_square(self) -> float:
        """``chi_square / dof``; NaN without degrees of freedom."""
        return self.chi_square / self.dof if self.dof else math.nan

    def range_sigma_mm(self, range_mm: ArrayLike) -> Array:
        """One-sigma error of a range, mm, that the fit's own uncertainty causes; any shape."""
        model = self.model
        depth = reals("range_mm", range_mm) + model.b_mm
        depth = np.where(depth > 0.0, depth, np.nan)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            mm_per_row = depth * depth / -model.product_mm_px
            slope = row_jacobian(model, depth, self.free) * mm_per_row[..., None]
            return np.asarray(np.sqrt(np.einsum("...i,ij,...j", slope, self.covariance, slope)))


def fit_targets(
    row: ArrayLike,
    range_mm: ArrayLike,
    design: RangeModel,
    free: Sequence[str] = PAPER_FREE,
    *,
    sigma_row_px: ArrayLike = 0.3,
    sigma_range_mm: ArrayLike = 0.0,
    prior_sigma: Mapping[str, float] | None = None,
) -> CalibrationFit:
    """Weighted least squares of Eq. 2 for the parameters in ``free``.

    Parameters
    ----------
    row : array_like of float, shape (n,)
        Where the targets appear, px, on the sensor.
    range_mm : array_like of float, shape (n,)
        Their ranges from the mechanical datum, mm.
    design : RangeModel
        Nominal build: values of the parameters that stay fixed, centres of the priors, start of
        the search.
    free : sequence of str
        Parameters to fit, of ``k_mm``, ``k_prime_px``, ``b_mm``, ``b_prime_px``. The default is the
        paper's method. It is solved in closed form on centred reciprocal depths with exactly
        rounded sums: the same targets in any order give the same bits.
    sigma_row_px, sigma_range_mm : array_like of float, scalar or shape (n,)
        Standard deviations of rows and ranges. They weight a target with
        ``sigma_row^2 + (K / (R + b)^2 sigma_range)^2``.
    prior_sigma : mapping of str to float, optional
        Standard deviations of Gaussian priors on free parameters, centred on ``design``.

    Returns
    -------
    CalibrationFit

    Raises
    ------
    ArgumentError
        When an argument is not finite, of the wrong shape, or names an unknown parameter.
    FitError
        When the targets do not determine the parameters; names the condition number.

    Notes
    -----
    Ranges depend on k and k' only through their product, so freeing both needs a prior on one.
    """
    rows, ranges = vector("row", row), vector("range_mm", range_mm)
    if rows.shape != ranges.shape:
        raise ArgumentError(
            f"row has {rows.size} entries and range_mm {ranges.size}; give one row per range"
        )
    _check_targets(rows, ranges, design)
    names = _checked_free(free)
    priors = _checked_priors(prior_sigma, names)
    sigma_row = _spread("sigma_row_px", sigma_row_px, rows.size, zero_allowed=False)
    sigma_range = _spread("sigma_range_mm", sigma_range_mm, rows.size, zero_allowed=True)
    model = design
    for _ in range(1 + _REWEIGHTINGS * bool(sigma_range.any())):
        depth = ranges + model.b_mm
        sigma = np.hypot(sigma_row, model.product_mm_px / (depth * depth) * sigma_range)
        _refuse_singular(rows, ranges, sigma, model, names, priors)
        if set(names) == set(PAPER_FREE) and not priors:
            model = straight_line(rows, ranges, sigma, design)
        else:
            model = search(rows, ranges, sigma, model, design, names, priors)
    return _result(rows, ranges, sigma, model, design, names, priors)


def _result(
    rows: Array,
    ranges: Array,
    sigma: Array,
    model: RangeModel,
    design: RangeModel,
    names: tuple[str, ...],
    priors: dict[str, float],
) -> CalibrationFit:
    scaled = jacobian(model, ranges, sigma, names, priors)
    condition = condition_number(scaled)
    residual = rows - model.row(ranges)
    pulls = [(getattr(model, n) - getattr(design, n)) / s for n, s in priors.items()]
    dof = rows.size + len(priors) - len(names)
    verdicts = []
    if condition > CONDITION_WARNING:
        verdicts.append(
            f"ill-conditioned: condition number {condition:.3g} exceeds {CONDITION_WARNING:g}; "
            "spread the targets over the range or fix b_mm"
        )
    if dof == 0:
        verdicts.append("no degrees of freedom: residuals say nothing; add targets")
    return CalibrationFit(
        model,
        names,
        covariance(scaled),
        residual,
        sigma,
        condition,
        dof,
        math.fsum([*(residual / sigma) ** 2, *(pull * pull for pull in pulls)]),
        tuple(verdicts),
    )


def _refuse_singular(
    rows: Array,
    ranges: Array,
    sigma: Array,
    model: RangeModel,
    names: tuple[str, ...],
    priors: Mapping[str, float],
) -> None:
    """Rank test on the scaled Jacobian; says in the user's terms why it fails."""
    free = ", ".join(names)
    if rows.size > 1 and np.ptp(rows) == 0.0 and np.ptp(ranges) > 0.0:
        raise FitError(
            f"row is {rows[0]:g} for all {rows.size} targets (condition number inf); "
            "give targets whose rows move with their range"
        )
    condition = condition_number(jacobian(model, ranges, sigma, names, priors))
    if math.isfinite(condition):
        return
    distinct = np.unique(ranges).size
    if {"k_mm", "k_prime_px"} <= set(names) and not {"k_mm", "k_prime_px"} & set(priors):
        remedy = "ranges show only the product k_mm k_prime_px: fix one or give it a prior_sigma"
    else:
        needed = len(set(names) - set(priors))
        remedy = f"give targets at {max(needed, 2)} different ranges or more"
    raise FitError(
        f"free is {free} and range_mm holds {distinct} different ranges: singular, condition "
        f"number {condition:g}; {remedy}"
    )


def _check_targets(rows: Array, ranges: Array, design: RangeModel) -> None:
    off = (rows < -0.5) | (rows > design.rows - 0.5)
    if off.any():
        raise ArgumentError(f"row is {rows[off][0]:g}; the sensor has rows 0 to {design.rows - 1}")
    behind = ranges + design.b_mm <= 0.0
    if behind.any():
        raise ArgumentError(
            f"range_mm is {ranges[behind][0]:g}; choose ranges beyond -b_mm = {-design.b_mm:g} mm"
        )


def _checked_free(free: Sequence[str]) -> tuple[str, ...]:
    names = tuple(free) if isinstance(free, list | tuple) else (free,)
    known = all(isinstance(name, str) and name in PARAMETERS for name in names)
    if not (names and known and len(set(names)) == len(names)):
        raise ArgumentError(f"free is {free!r}; name each once, of {', '.join(PARAMETERS)}")
    return names


def _checked_priors(
    prior_sigma: Mapping[str, float] | None, names: tuple[str, ...]
) -> dict[str, float]:
    if not isinstance(prior_sigma, Mapping | None):
        raise ArgumentError(f"prior_sigma is {prior_sigma!r}; give a number for each name")
    priors = dict(prior_sigma or {})
    for name, spread in priors.items():
        if name not in names:
            raise ArgumentError(f"prior_sigma names {name!r}; free is {', '.join(names)}")
        positive(f"prior_sigma of {name}", spread)
    return priors


def _spread(name: str, value: ArrayLike, size: int, *, zero_allowed: bool) -> Array:
    given = reals(name, value)
    array = vector(name, np.broadcast_to(given, size) if given.ndim == 0 else given)
    if array.size != size:
        raise ArgumentError(f"{name} has {array.size} entries; give one or {size}")
    wrong = array < 0.0 if zero_allowed else array <= 0.0
    if wrong.any():
        least = "0 or more" if zero_allowed else "a positive number"
        raise ArgumentError(f"{name} is {array[wrong][0]:g}; choose {least}")
    return array
