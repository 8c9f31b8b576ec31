"""Fitting the range equation to targets at known ranges (Eq. 2).

Residuals are counted in rows: there the errors are, and a far target does not outweigh the near
ones. Sign conventions as in :class:`~eschorty_ros.core.optics.range_model.RangeModel`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array, broadcast, reals
from eschorty_ros.core.base.errors import FitError
from eschorty_ros.core.calibration._checks import (
    check_targets,
    checked_free,
    checked_priors,
)
from eschorty_ros.core.calibration._least_squares import condition_number, covariance
from eschorty_ros.core.calibration._model import (
    COLUMN_TERMS,
    PARAMETERS,
    WIDTH_BIAS,
    Observed,
    row_derivative,
    values_of,
)
from eschorty_ros.core.calibration._solvers import PAPER_FREE, Problem, build, solve
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import RangeModel

__all__ = [
    "COLUMN_TERMS",
    "CONDITION_WARNING",
    "K_PRIOR_SHARE",
    "PAPER_FREE",
    "PARAMETERS",
    "PRIOR_SIGMA",
    "WIDTH_BIAS",
    "CalibrationFit",
    "fit",
    "fit_targets",
]

CONDITION_WARNING = 1e3
PRIOR_SIGMA = {
    "k_prime_px": 3000.0,
    "b_mm": 3.0,
    "b_prime_px": 60.0,
    "b_prime_1_px": 15.0,
    "b_prime_2_px": 5.0,
    WIDTH_BIAS: 3.0,
}
"""How far a build is expected from its design; k lies within `K_PRIOR_SHARE` of it."""
K_PRIOR_SHARE = 0.01


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
    lateral_residual_px, lateral_sigma_px : ndarray of float64, shape (n, 2)
        The same for widths and spacings; NaN where there is none or k stays fixed.
    width_bias_px : float
        Columns by which lit targets appear too wide; 0 unless fitted.
    prior_sigma : dict of str to float
        Standard deviations of the priors.
    condition_number : float
        Of the Jacobian of targets and priors with columns of unit length.
    dof : int
        Rows, widths, spacings and priors minus free parameters.
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
    lateral_residual_px: Array
    lateral_sigma_px: Array
    width_bias_px: float
    prior_sigma: dict[str, float]
    condition_number: float
    dof: int
    chi_square: float
    verdicts: tuple[str, ...]

    @property
    def reduced_chi_square(self) -> float:
        """``chi_square / dof``; NaN without degrees of freedom."""
        return self.chi_square / self.dof if self.dof else math.nan

    @property
    def values(self) -> dict[str, float]:
        """Every parameter by name, fitted or not."""
        return values_of(self.model) | {WIDTH_BIAS: self.width_bias_px}

    def range_sigma_mm(self, range_mm: ArrayLike, column: ArrayLike | None = None) -> Array:
        """One-sigma error of a range, mm, that the fit's own uncertainty causes; any shape."""
        model, p = self.model, self.values
        depth = reals("range_mm", range_mm) + model.b_mm
        depth = np.where(depth > 0.0, depth, np.nan)
        u = np.zeros(()) if column is None else model.normalised_column(column)
        broadcast("range_mm and column", depth, u)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            # An unknown column makes an unknown depth.
            depth, u = np.broadcast_arrays(depth + 0.0 * u, u)
            mm_per_row = depth * depth / -model.product_mm_px
            by_row = np.stack([row_derivative(p, depth, u, name) for name in self.free], axis=-1)
            slope = by_row * mm_per_row[..., None]
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
    """Weighted least squares of Eq. 2 on bare rows and ranges.

    Parameters
    ----------
    row, range_mm : array_like of float, shape (n,)
        Where the targets appear, px, and their ranges from the mechanical datum, mm.
    sigma_row_px, sigma_range_mm : array_like of float, scalar or shape (n,)
        Their standard deviations.
    design, free, prior_sigma
        As in `fit`, which also says what is raised.

    Returns
    -------
    CalibrationFit
    """
    targets = Targets(row, range_mm, sigma_row_px, sigma_range_mm)
    return fit(targets, design, free, prior_sigma=prior_sigma)


def fit(
    targets: Targets,
    design: RangeModel,
    free: Sequence[str] = PAPER_FREE,
    *,
    prior_sigma: Mapping[str, float] | None = None,
) -> CalibrationFit:
    """Weighted least squares of Eq. 2, and of known sizes where k is free.

    Parameters
    ----------
    targets : Targets
        A row weighs with ``sigma_row^2 + (K / (R + b)^2 sigma_range)^2``; the range error that row
        and width of one target share is accounted for.
    design : RangeModel
        Nominal build: values of the parameters that stay fixed, centres of the priors, start of
        the search.
    free : sequence of str
        Parameters to fit, of ``k_mm``, ``k_prime_px``, ``b_mm``, ``b_prime_px``,
        ``b_prime_1_px``, ``b_prime_2_px``, ``width_bias_px``. The default is the paper's method.
        It is solved in closed form on centred reciprocal depths with exactly rounded sums: the
        same targets in any order give the same bits.
    prior_sigma : mapping of str to float, optional
        Standard deviations of Gaussian priors on free parameters, centred on ``design``; on a
        width bias centred on 0. Infinity means no prior.

    Returns
    -------
    CalibrationFit

    Raises
    ------
    ArgumentError
        When a target lies off the sensor or behind the focal line, or a name is unknown.
    FitError
        When the targets do not determine the parameters; names the condition number.

    Notes
    -----
    Ranges depend on k and k' only through their product, so freeing both needs sizes, spacings or
    a prior on one.
    """
    names = checked_free(free)
    priors = checked_priors(prior_sigma, names)
    priors = {name: spread for name, spread in priors.items() if spread != math.inf}
    check_targets(targets, design, names)
    observed = Observed.of(targets, design)
    if not {"k_mm", WIDTH_BIAS} & set(names):
        observed = observed.rows_only()
    problem, values = solve(observed, design, names, priors)
    return _result(problem, build(design, values), values[WIDTH_BIAS])


def _result(problem: Problem, model: RangeModel, width_bias_px: float) -> CalibrationFit:
    values = values_of(model) | {WIDTH_BIAS: width_bias_px}
    free = problem.free(values)
    scaled = problem.jacobian(free)
    condition = condition_number(scaled)
    dof = scaled.shape[0] - len(problem.names)
    verdicts = []
    if condition > CONDITION_WARNING:
        verdicts.append(
            f"ill-conditioned: condition number {condition:.3g} exceeds {CONDITION_WARNING:g}; "
            "spread the targets over the range or fix b_mm"
        )
    if dof == 0:
        verdicts.append("no degrees of freedom: residuals say nothing; add targets")
    seen, white = problem.observed.residual(values), problem.residual(free)
    if seen is None or white is None:
        raise FitError("the targets lead to no possible build; check them")
    known = problem.observed.known[:, 1:]
    return CalibrationFit(
        model,
        problem.names,
        covariance(scaled),
        seen[:, 0],
        problem.sigma_px[:, 0],
        np.where(known, seen[:, 1:], np.nan),
        np.where(known, problem.sigma_px[:, 1:], np.nan),
        width_bias_px,
        problem.priors,
        condition,
        dof,
        math.fsum(white * white),
        tuple(verdicts),
    )
