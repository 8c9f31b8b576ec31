"""Fitting the range equation (Eq. 2) to targets at known ranges.

Residuals are counted in rows: there the errors are, and a far target does not outweigh the near
ones. Sign conventions as in :class:`~eschorty_ros.core.optics.RangeModel`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array, broadcast, reals
from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.base.numbers import positive
from eschorty_ros.core.calibration.residuals import (
    COLUMN_TERMS,
    EVERY,
    PARAMETERS,
    WIDTH_BIAS,
    Observed,
    Problem,
    Values,
    condition_number,
    covariance,
    row_derivative,
    values_of,
)
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import RangeModel

CONDITION_WARNING = 1e3
PAPER_FREE = ("k_prime_px", "b_prime_px")
"""Parameters that the paper fits; k and b stay at their design values."""
PRIOR_SIGMA = {
    "k_prime_px": 3000.0,
    "b_mm": 3.0,
    "b_prime_px": 60.0,
    "b_prime_1_px": 15.0,
    "b_prime_2_px": 5.0,
    WIDTH_BIAS: 3.0,
}
"""Standard deviation of a build's parameters from its design; of k it is `K_PRIOR_SHARE`."""
K_PRIOR_SHARE = 0.01
_REWEIGHTINGS = 3
_TOLERANCE = float(np.finfo(np.float64).eps)
# A robust search only finds out which targets a least-squares fit uses.
_START_TOLERANCE = 1e-9
_EVALUATIONS_MAX = 500
# Residual of an impossible build: finite, its square too, and larger than any other.
_IMPOSSIBLE = 1e50


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFit:
    """A build fitted to targets, with its uncertainty."""

    model: RangeModel
    """The fitted range equation."""
    free: tuple[str, ...]
    """Names of the fitted parameters, in the order of ``covariance``."""
    covariance: Array
    """Shape (p, p). From the stated standard deviations of targets and priors, never from the
    residuals, so it also holds with no degrees of freedom left. Units of the parameters."""
    residual_px: Array
    """Shape (n,). Row as measured minus row as fitted."""
    sigma_px: Array
    """Shape (n,). Standard deviation of each residual: row and range error together."""
    width_bias_px: float
    """Columns by which lit targets appear too wide; 0 unless fitted."""
    prior_sigma: dict[str, float]
    """Standard deviations of the priors."""
    condition_number: float
    """Of the Jacobian of targets and priors with columns of unit length."""
    dof: int
    """Rows, widths, spacings and priors minus free parameters."""
    chi_square: float
    """Sum of squared residuals of targets and priors over their standard deviations."""
    verdicts: tuple[str, ...]
    """One line for each reservation; empty when there is none."""

    @property
    def reduced_chi_square(self) -> float:
        """``chi_square / dof``; NaN without degrees of freedom."""
        return self.chi_square / self.dof if self.dof else math.nan

    @property
    def values(self) -> dict[str, float]:
        """Every parameter by name, fitted or not."""
        return values_of(self.model) | {WIDTH_BIAS: self.width_bias_px}

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of every fitted parameter by name."""
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def range_sigma_mm(self, range_mm: ArrayLike, column: ArrayLike | None = None) -> Array:
        """Return the standard deviation that the fit's uncertainty causes in a range, mm.

        Both arguments may have any shape.
        """
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


def fit(
    targets: Targets,
    design: RangeModel,
    free: Sequence[str] = PAPER_FREE,
    *,
    prior_sigma: Mapping[str, float] | None = None,
) -> CalibrationFit:
    """Fit Eq. 2 by weighted least squares, and known sizes with it where k is free.

    Ranges depend on k and k' only through their product, so freeing both needs sizes, spacings or a
    prior on one.

    - ``targets``: A row weighs with ``sigma_row^2 + (K / (R + b)^2 sigma_range)^2``; the range
      error that row and width of one target share is accounted for.
    - ``design``: Nominal build: values of the parameters that stay fixed, centres of the priors,
      start of the search.
    - ``free``: Parameters to fit, of ``k_mm``, ``k_prime_px``, ``b_mm``, ``b_prime_px``,
      ``b_prime_1_px``, ``b_prime_2_px``, ``width_bias_px``. The default is the paper's method. It
      is solved in closed form on centred reciprocal depths with exactly rounded sums: the same
      targets in any order give the same bits.
    - ``prior_sigma``: Standard deviations of Gaussian priors on free parameters, centred on
      ``design``; on a width bias centred on 0. Infinity means no prior.

    Raises ``ArgumentError`` when a target is off the sensor or behind the focal line, or a name is
    unknown. Raises ``FitError`` when the targets do not determine the parameters; names the
    condition number.

    Examples
    --------
    >>> from eschorty_ros.core.calibration import Targets, fit
    >>> from eschorty_ros.core.optics import RangeModel
    >>> design = RangeModel(k_mm=24.06, k_prime_px=-36500.0, b_mm=0.0, b_prime_px=-1084.0)
    >>> targets = Targets(row=[108.0, 352.5, 596.0], range_mm=[900.0, 1200.0, 1800.0])
    >>> found = fit(targets, design)
    >>> found.free
    ('k_prime_px', 'b_prime_px')
    >>> print(found.model.range_mm(352.0).round(1), found.range_sigma_mm(1200.0).round(2))
    1199.7 0.28
    """
    names = checked_free(free)
    priors = checked_priors(prior_sigma, names)
    priors = {name: spread for name, spread in priors.items() if spread != math.inf}
    check_targets(targets, design, names)
    problem, values = solve(Observed.of(targets, design, names), design, names, priors)
    model, at = build(design, values), problem.free(values)
    jacobian = problem.jacobian(at)
    condition = condition_number(jacobian)
    dof = jacobian.shape[0] - len(names)
    verdicts = []
    if condition > CONDITION_WARNING:
        verdicts.append(
            f"ill-conditioned: condition number {condition:.3g} exceeds {CONDITION_WARNING:g}; "
            "spread the targets over the range or fix b_mm"
        )
    if dof == 0:
        verdicts.append("no degrees of freedom: the residuals carry no information; add targets")
    spread = covariance(jacobian)
    # The fitted parameters move with an error that all ranges share.
    moved = spread @ (jacobian.T @ problem.shared(values))
    residual, white = problem.observed.residual(values), problem.residual(at)
    if residual is None or white is None:
        raise FitError("the targets lead to no possible build; check them")
    return CalibrationFit(
        model=model,
        free=names,
        covariance=spread + np.outer(moved, moved),
        residual_px=residual[:, 0],
        sigma_px=problem.sigma_px[:, 0],
        width_bias_px=values[WIDTH_BIAS],
        prior_sigma=priors,
        condition_number=condition,
        dof=dof,
        chi_square=math.fsum(white * white),
        verdicts=tuple(verdicts),
    )


def solve(
    observed: Observed, design: RangeModel, names: tuple[str, ...], priors: Mapping[str, float]
) -> tuple[Problem, Values]:
    """Return the problem and the parameters of its smallest sum of squares.

    Raises ``FitError`` when the targets do not determine the parameters.
    """
    closed = set(names) == set(PAPER_FREE) and not priors and not observed.known[:, 1:].any()
    values = values_of(design)
    # The weight of a range error depends on the slope of the curve, which the fit determines.
    for _ in range(1 + _REWEIGHTINGS * bool(observed.sigma_range_mm.any())):
        problem = Problem(observed, design, names, priors, values)
        if not names:
            return problem, values
        refuse_singular(problem, values)
        if closed:
            values = _straight_line(observed, problem.sigma_px[:, 0], design)
        else:
            values = search(problem, values)
        build(design, values)
    return problem, values


def _straight_line(observed: Observed, sigma: Array, design: RangeModel) -> Values:
    """Fit row = K x - b' on x = 1 / (R + b), centred: one column of condition 1."""
    rows = observed.measured[:, 0]
    x = 1.0 / (observed.range_mm + design.b_mm)
    weight = 1.0 / (sigma * sigma)
    total = math.fsum(weight)
    x_mean, row_mean = math.fsum(weight * x) / total, math.fsum(weight * rows) / total
    u, v = (x - x_mean) / sigma, (rows - row_mean) / sigma
    length = math.sqrt(math.fsum(u * u))
    product = math.fsum((u / length) * v) / length
    # The mean residual corrects the rounding of the means.
    rest = math.fsum(weight * (rows - row_mean - product * (x - x_mean))) / total
    return values_of(design) | {
        "k_prime_px": product / design.k_mm,
        "b_prime_px": product * x_mean - row_mean - rest,
    }


def search(problem: Problem, start: Values, cauchy_scale: float | None = None) -> Values:
    """Return the values of the smallest sum of squares, from ``start`` on.

    - ``cauchy_scale``: Targets count by Cauchy's loss of their squared residuals' sum, in units of
      the square of this many standard deviations; priors stay squared.

    Raises ``FitError`` when the search does not converge.
    """
    # Only a calibration needs it, and the import takes 0.3 s.
    from scipy.optimize import least_squares

    robust = cauchy_scale is not None
    tolerance = _START_TOLERANCE if robust else _TOLERANCE
    target = np.nonzero(problem.observed.known)[0]

    def residual(free: Array) -> Array:
        found = problem.residual(free)
        return np.full(target.size + len(problem.priors), _IMPOSSIBLE) if found is None else found

    def loss(square: Array) -> Array:
        rho = np.stack([square, np.ones_like(square), np.zeros_like(square)])
        # One loss for each target: a wrong one is wrong in all its channels.
        joint = 1.0 + np.bincount(target, square[: target.size])[target]
        rho[0, : target.size] = np.log(joint) / np.bincount(target)[target]
        rho[1, : target.size] = 1.0 / joint
        return rho

    begin = problem.free(start)
    found = least_squares(
        residual,
        begin,
        problem.jacobian,
        method="trf" if robust else "lm",
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
        loss=loss if robust else "linear",
        f_scale=cauchy_scale or 1.0,
        max_nfev=_EVALUATIONS_MAX,
    )
    if not found.success:
        condition = condition_number(problem.jacobian(begin))
        raise FitError(
            f"the search for {', '.join(problem.names)} does not end (condition number "
            f"{condition:.3g}); add targets at other ranges or a prior_sigma"
        )
    return problem.values(found.x)


def build(design: RangeModel, values: Values) -> RangeModel:
    """Return the build with these parameters.

    Raises ``FitError`` when there is no such build.
    """
    try:
        named: dict[str, Any] = {name: values[name] for name in (*PARAMETERS, *COLUMN_TERMS)}
        return replace(design, **named)
    except ArgumentError as error:
        raise FitError(f"the targets lead to no possible build: {error}; check them") from error


def refuse_singular(problem: Problem, values: Mapping[str, float]) -> None:
    """Raise FitError with cause and remedy where the scaled Jacobian lacks rank."""
    observed, names, priors = problem.observed, set(problem.names), set(problem.priors)
    rows, ranges = observed.measured[:, 0], observed.range_mm
    if rows.size > 1 and np.ptp(rows) == 0.0 and np.ptp(ranges) > 0.0:
        raise FitError(
            f"row is {rows[0]:g} for all {rows.size} targets (condition number inf); "
            "give targets whose rows move with their range"
        )
    condition = condition_number(problem.jacobian(problem.free(values)))
    if math.isfinite(condition):
        return
    sized = bool(observed.known[:, 1:].any())
    if {"k_mm", "k_prime_px"} <= names and not sized and not {"k_mm", "k_prime_px"} & priors:
        remedy = (
            "ranges show only the product k_mm k_prime_px: give sizes or spacings of targets, "
            "fix one or give it a prior_sigma"
        )
    elif WIDTH_BIAS in names - priors and not sized:
        remedy = "only targets of known size show a width bias: give sizes or fix width_bias_px"
    elif len(np.unique(observed.column_u)) <= len(set(COLUMN_TERMS) & names - priors):
        remedy = f"give targets in different columns or fix {' and '.join(COLUMN_TERMS)}"
    else:
        remedy = f"give targets at {max(len(names - priors), 2)} different ranges or more"
    raise FitError(
        f"free is {', '.join(problem.names)} and range_mm holds {np.unique(ranges).size} different "
        f"ranges: singular, condition number {condition:g}; {remedy}"
    )


def check_targets(targets: Targets, design: RangeModel, names: tuple[str, ...]) -> None:
    """Refuse no targets, and targets off the sensor or behind the focal line, by name."""
    if not len(targets):
        raise FitError("there are 0 targets (condition number inf); give targets at known ranges")
    for name, pixels in (("row", design.rows), ("column", design.columns)):
        place = getattr(targets, name)
        off = (place < -0.5) | (place > pixels - 0.5)
        if off.any():
            at = int(np.flatnonzero(off)[0])
            raise ArgumentError(
                f"{name} of target {targets.labels[at]} is {place[at]:g}; the sensor has {name}s 0 "
                f"to {pixels - 1}"
            )
    behind = targets.range_mm + design.b_mm <= 0.0
    if behind.any():
        raise ArgumentError(
            f"range_mm is {targets.range_mm[behind][0]:g}; choose ranges beyond -b_mm = "
            f"{0.0 - design.b_mm:g} mm"
        )
    if np.isnan(targets.column).any():
        at = int(np.flatnonzero(np.isnan(targets.column))[0])
        unknown = f"column of target {targets.labels[at]} is unknown"
        if set(COLUMN_TERMS) & set(names):
            raise ArgumentError(
                f"{unknown}; give the column of every target or fix {' and '.join(COLUMN_TERMS)}"
            )
        for name in COLUMN_TERMS:
            if getattr(design, name) != 0.0:
                raise ArgumentError(
                    f"{unknown} and {name} of the nominal build is {getattr(design, name):g}; give "
                    "the column of every target"
                )


def checked_free(free: Sequence[str]) -> tuple[str, ...]:
    """Return the names of free parameters; ArgumentError for an unknown or repeated one."""
    names = tuple(free) if isinstance(free, list | tuple) else (free,)
    known = all(isinstance(name, str) and name in EVERY for name in names)
    if not (names and known and len(set(names)) == len(names)):
        given = ", ".join(map(str, names)) or "empty"
        raise ArgumentError(f"free is {given}; name each once, of {', '.join(EVERY)}")
    return names


def checked_priors(
    prior_sigma: Mapping[str, float] | None, names: tuple[str, ...]
) -> dict[str, float]:
    """Return the priors' standard deviations; ArgumentError for one of no free parameter."""
    if not isinstance(prior_sigma, Mapping | None):
        raise ArgumentError(f"prior_sigma is {prior_sigma!r}; give a number for each name")
    priors = dict(prior_sigma or {})
    for name, spread in priors.items():
        if name not in names:
            raise ArgumentError(f"prior_sigma names {name!r}; free is {', '.join(names)}")
        if spread != math.inf:
            positive(f"prior_sigma of {name}", spread)
    return priors
