"""Solving Eq. 2 for its parameters: closed form where it is linear, damped search where not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration._least_squares import condition_number
from eschorty_ros.core.calibration._model import (
    COLUMN_TERMS,
    PARAMETERS,
    WIDTH_BIAS,
    Observed,
    Values,
    values_of,
)
from eschorty_ros.core.optics import POLE_MARGIN_PX, RangeModel

PAPER_FREE = ("k_prime_px", "b_prime_px")
"""What the paper fits: k and b stay at their design values."""
_REWEIGHTINGS = 3
_TOLERANCE = float(np.finfo(np.float64).eps)
# A robust search only finds out which targets a least-squares fit uses.
_START_TOLERANCE = 1e-9
_EVALUATIONS_MAX = 500
_IMPOSSIBLE = 1e50


class Problem:
    """Whitened residuals of targets, then of priors, and their derivatives.

    Parameters
    ----------
    observed : Observed
    design : RangeModel
        Values of parameters that stay fixed, centres of the priors.
    names : tuple of str
        Free parameters.
    priors : mapping of str to float
        Standard deviations.
    at : Values
        Where the targets' covariances are taken.
    """

    def __init__(
        self,
        observed: Observed,
        design: RangeModel,
        names: tuple[str, ...],
        priors: Mapping[str, float],
        at: Values,
    ) -> None:
        self.observed, self.design, self.names, self.priors = observed, design, names, dict(priors)
        root = observed.root_covariance(at)
        self.root = root
        self.whitener = np.linalg.inv(root)
        self.sigma_px = np.linalg.norm(root, axis=2)
        self._fixed = values_of(design)
        self._centre = np.array([self._fixed[name] for name in self.priors])
        self._spread = np.array(list(self.priors.values()))
        self._which = [names.index(name) for name in self.priors]
        # Channels nobody measured would only lengthen the Jacobian.
        self._rows = observed.known.ravel()

    def values(self, free: Array) -> Values:
        return self._fixed | dict(zip(self.names, free.tolist(), strict=True))

    def free(self, values: Mapping[str, float]) -> Array:
        return np.array([values[name] for name in self.names])

    def residual(self, free: Array) -> Array | None:
        """Return expected minus seen in standard deviations; ``None`` for no possible build."""
        p = self.values(free)
        signs = p["k_mm"] > 0.0 > p["k_prime_px"] and p["b_prime_px"] <= -POLE_MARGIN_PX
        seen = self.observed.residual(p) if signs else None
        if seen is None:
            return None
        white = -np.einsum("nij,nj->ni", self.whitener, seen).ravel()[self._rows]
        return np.concatenate([white, (free[self._which] - self._centre) / self._spread])

    def jacobian(self, free: Array) -> Array:
        direct = self.observed.derivative(self.values(free), self.names)
        white = np.einsum("nij,njp->nip", self.whitener, direct)
        held = np.zeros((len(self.priors), len(self.names)))
        held[np.arange(len(self.priors)), self._which] = 1.0 / self._spread
        return np.concatenate([white.reshape(-1, len(self.names))[self._rows], held])

    def distance(self, values: Values) -> Array:
        """Whitened residuals, shape (n, 3); infinite for no build."""
        seen = self.observed.residual(values)
        if seen is None:
            return np.full(self.observed.seen.shape, np.inf)
        return np.asarray(np.einsum("nij,nj->ni", self.whitener, seen))

    def leverage(self, values: Values, covariance: Array) -> Array:
        """Covariance of the whitened expected channels, shape (n, 3, 3)."""
        direct = self.observed.derivative(values, self.names)
        white = np.einsum("nij,njp->nip", self.whitener, direct)
        white = np.where(self.observed.known[:, :, None], white, 0.0)
        return np.asarray(np.einsum("nip,pq,njq->nij", white, covariance, white))


def solve(
    observed: Observed, design: RangeModel, names: tuple[str, ...], priors: Mapping[str, float]
) -> tuple[Problem, Values]:
    """Parameters of the smallest sum of squares, and the problem they solve.

    Raises
    ------
    FitError
        When the targets do not determine the parameters.
    """
    closed = set(names) == set(PAPER_FREE) and not priors and not observed.known[:, 1:].any()
    values = values_of(design)
    # A range error weighs with the slope of the curve, which the fit has yet to find.
    for _ in range(1 + _REWEIGHTINGS * bool(observed.sigma_range_mm.any())):
        problem = Problem(observed, design, names, priors, values)
        if not names:
            return problem, values
        refuse_singular(problem, values)
        if closed:
            values = straight_line(observed, problem.sigma_px[:, 0], design)
        else:
            values = search(problem, values)
        build(design, values)
    return problem, values


def straight_line(observed: Observed, sigma: Array, design: RangeModel) -> Values:
    """Row = K x - b' on x = 1 / (R + b), centred: one column of condition 1."""
    rows = observed.seen[:, 0]
    x = 1.0 / (observed.range_mm + design.b_mm)
    weight = 1.0 / (sigma * sigma)
    total = math.fsum(weight)
    x_mean, row_mean = math.fsum(weight * x) / total, math.fsum(weight * rows) / total
    u, v = (x - x_mean) / sigma, (rows - row_mean) / sigma
    length = math.sqrt(math.fsum(u * u))
    product = math.fsum((u / length) * v) / length
    # What rounding left in the means comes back through the mean residual.
    rest = math.fsum(weight * (rows - row_mean - product * (x - x_mean))) / total
    return values_of(design) | {
        "k_prime_px": product / design.k_mm,
        "b_prime_px": product * x_mean - row_mean - rest,
    }


def search(problem: Problem, start: Values, cauchy_scale: float | None = None) -> Values:
    """Return the values of the smallest sum of squares, from ``start`` on.

    Parameters
    ----------
    problem : Problem
    start : Values
    cauchy_scale : float, optional
        Residuals of targets count by Cauchy's loss beyond this many standard deviations; those of
        priors stay squared.

    Raises
    ------
    FitError
        When the search does not converge.
    """
    # 0.3 s to import, which only a calibration has to spend.
    from scipy.optimize import least_squares

    robust = cauchy_scale is not None
    tolerance = _START_TOLERANCE if robust else _TOLERANCE
    targets = problem.observed.known.sum()

    def residual(free: Array) -> Array:
        found = problem.residual(free)
        # The search shortens a step that leads to no possible build.
        return np.full(targets + len(problem.priors), _IMPOSSIBLE) if found is None else found

    def loss(square: Array) -> Array:
        rho = np.stack([square, np.ones_like(square), np.zeros_like(square)])
        softened = 1.0 + square[:targets]
        rho[:, :targets] = np.log(softened), 1.0 / softened, -1.0 / softened**2
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
    """Build with these parameters.

    Raises
    ------
    FitError
        When there is no such build.
    """
    try:
        named: dict[str, Any] = {name: values[name] for name in (*PARAMETERS, *COLUMN_TERMS)}
        return replace(design, **named)
    except ArgumentError as error:
        raise FitError(f"the targets lead to no possible build: {error}; check them") from error


def refuse_singular(problem: Problem, values: Mapping[str, float]) -> None:
    """Rank test on the scaled Jacobian; says in the user's terms why it fails."""
    observed, names, priors = problem.observed, set(problem.names), set(problem.priors)
    rows, ranges = observed.seen[:, 0], observed.range_mm
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
    else:
        remedy = f"give targets at {max(len(names - priors), 2)} different ranges or more"
    raise FitError(
        f"free is {', '.join(problem.names)} and range_mm holds {np.unique(ranges).size} different "
        f"ranges: singular, condition number {condition:g}; {remedy}"
    )
