"""Solving Eq. 2 for its parameters: closed form where it is linear, damped search where not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core._calibration_model import (
    COLUMN_TERMS,
    PARAMETERS,
    WIDTH_BIAS,
    Observed,
    Values,
    values_of,
)
from eschorty_ros.core._least_squares import condition_number, minimise
from eschorty_ros.core.errors import ArgumentError, FitError
from eschorty_ros.core.optics import POLE_MARGIN_PX, RangeModel

Array = NDArray[np.float64]

PAPER_FREE = ("k_prime_px", "b_prime_px")
"""What the paper fits: k and b stay at their design values."""
_REWEIGHTINGS = 3


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
    weight : ndarray, shape (n,), optional
        Square root of each target's weight in a robust fit.
    """

    def __init__(
        self,
        observed: Observed,
        design: RangeModel,
        names: tuple[str, ...],
        priors: Mapping[str, float],
        at: Values,
        weight: Array | None = None,
    ) -> None:
        self.observed, self.design, self.names, self.priors = observed, design, names, dict(priors)
        root = observed.root_covariance(at)
        self.root = root
        self.unit_whitener = np.linalg.inv(root)
        self.whitener = (
            self.unit_whitener if weight is None else weight[:, None, None] * self.unit_whitener
        )
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
        """Expected minus seen over the standard deviation; ``None`` for no possible build."""
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
        """Whitened residuals without robust weights, shape (n, 3); infinite for no build."""
        seen = self.observed.residual(values)
        if seen is None:
            return np.full(self.observed.seen.shape, np.inf)
        return np.asarray(np.einsum("nij,nj->ni", self.unit_whitener, seen))

    def leverage(self, values: Values, covariance: Array) -> Array:
        """Covariance of the whitened expected channels, shape (n, 3, 3)."""
        direct = self.observed.derivative(values, self.names)
        white = np.einsum("nij,njp->nip", self.unit_whitener, direct)
        white = np.where(self.observed.known[:, :, None], white, 0.0)
        return np.asarray(np.einsum("nip,pq,njq->nij", white, covariance, white))

    def size(self) -> float:
        """Length of the vector of fitted values, against which steps count as small."""
        seen = np.where(self.observed.known, self.observed.seen / self.sigma_px, 0.0)
        held = np.linalg.norm(self._centre / self._spread)
        return float(np.linalg.norm(seen) + held) + math.sqrt(len(self.observed))


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


def search(problem: Problem, start: Values) -> Values:
    """Values of the smallest sum of squares, from ``start`` on.

    Raises
    ------
    FitError
        When the search does not end.
    """
    straight = _Straightened(problem, float(np.mean(problem.observed.range_mm)))

    def derivative(searched: Array) -> Array:
        direct = problem.jacobian(straight.parameters(searched))
        return np.asarray(direct @ straight.derivative(searched))

    begin = straight.searched(start)
    found = minimise(
        begin, lambda s: problem.residual(straight.parameters(s)), derivative, problem.size()
    )
    if found is None:
        condition = condition_number(derivative(begin))
        raise FitError(
            f"the search for {', '.join(problem.names)} does not end (condition number "
            f"{condition:.3g}); add targets at other ranges or a prior_sigma"
        )
    return problem.values(straight.parameters(found))


class _Straightened:
    """Parameters in which the valley of the sum of squares is straight.

    With b free, k' and b' are searched as slope and height of the curve in the middle of the
    targets: then b is its curvature alone. Otherwise the parameters are searched as they are.
    """

    def __init__(self, problem: Problem, middle_mm: float) -> None:
        self._names, self._problem, self._middle_mm = problem.names, problem, middle_mm
        self._active = {"k_prime_px", "b_mm", "b_prime_px"} <= set(problem.names)

    def searched(self, start: Values) -> Array:
        values = dict(start)
        if self._active:
            depth = self._middle_mm + values["b_mm"]
            product = values["k_mm"] * values["k_prime_px"]
            values["b_prime_px"] = product / depth - values["b_prime_px"]
            values["k_prime_px"] = -product / (depth * depth)
        return self._problem.free(values)

    def parameters(self, searched: Array) -> Array:
        if not self._active:
            return searched
        p = self._problem.values(searched)
        depth, slope = self._middle_mm + p["b_mm"], p["k_prime_px"]
        p["k_prime_px"] = -slope * depth * depth / p["k_mm"]
        p["b_prime_px"] = -slope * depth - p["b_prime_px"]
        return self._problem.free(p)

    def derivative(self, searched: Array) -> Array:
        """Parameters (rows) by searched ones (columns)."""
        matrix = np.eye(len(self._names))
        if not self._active:
            return matrix
        p = self._problem.values(searched)
        depth, slope, k_mm = self._middle_mm + p["b_mm"], p["k_prime_px"], p["k_mm"]
        at = {name: index for index, name in enumerate(self._names)}
        k_prime, b_prime, b = at["k_prime_px"], at["b_prime_px"], at["b_mm"]
        matrix[k_prime, k_prime] = -depth * depth / k_mm
        matrix[k_prime, b] = -2.0 * slope * depth / k_mm
        if "k_mm" in at:
            matrix[k_prime, at["k_mm"]] = slope * (depth / k_mm) ** 2
        matrix[b_prime, k_prime] = -depth
        matrix[b_prime, b] = -slope
        matrix[b_prime, b_prime] = -1.0
        return matrix


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
