"""Fitting the range equation to targets at known ranges (Eq. 2).

Residuals are counted in rows: there the errors are, and a far target does not outweigh the near
ones. Sign conventions as in :class:`~eschorty_ros.core.optics.RangeModel`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core._checks import vector
from eschorty_ros.core._least_squares import condition_number, covariance, minimise
from eschorty_ros.core.errors import ArgumentError, FitError
from eschorty_ros.core.optics import POLE_MARGIN_PX, RangeModel

Array = NDArray[np.float64]

PARAMETERS = ("k_mm", "k_prime_px", "b_mm", "b_prime_px")
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
        depth = np.asarray(range_mm, dtype=np.float64) + model.b_mm
        depth = np.where(depth > 0.0, depth, np.nan)
        rows_per_mm = -model.product_mm_px / (depth * depth)
        slope = row_jacobian(model, depth, self.free) / rows_per_mm[..., None]
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
    names, priors = _checked_free(free), dict(prior_sigma or {})
    _check_priors(priors, names)
    sigma_row = _spread("sigma_row_px", sigma_row_px, rows.size, zero_allowed=False)
    sigma_range = _spread("sigma_range_mm", sigma_range_mm, rows.size, zero_allowed=True)
    model = design
    for _ in range(1 + _REWEIGHTINGS * bool(sigma_range.any())):
        depth = ranges + model.b_mm
        sigma = np.hypot(sigma_row, model.product_mm_px / (depth * depth) * sigma_range)
        _refuse_singular(rows, ranges, sigma, model, names, priors)
        if set(names) == set(PAPER_FREE) and not priors:
            model = _straight_line(rows, ranges, sigma, design)
        else:
            model = _search(rows, ranges, sigma, model, design, names, priors)
    return _result(rows, ranges, sigma, model, design, names, priors)


def row_jacobian(model: RangeModel, depth_mm: Array, names: Sequence[str]) -> Array:
    """Differentiate the row (Eq. 2) by the named parameters, which become the last axis."""
    product = model.product_mm_px
    columns = {
        "k_mm": model.k_prime_px / depth_mm,
        "k_prime_px": model.k_mm / depth_mm,
        "b_mm": -product / (depth_mm * depth_mm),
        "b_prime_px": np.full_like(depth_mm, -1.0),
    }
    return np.stack([columns[name] for name in names], axis=-1)


def _straight_line(rows: Array, ranges: Array, sigma: Array, design: RangeModel) -> RangeModel:
    """Row = K x - b' on x = 1 / (R + b), centred: one column of condition 1."""
    x = 1.0 / (ranges + design.b_mm)
    weight = 1.0 / (sigma * sigma)
    total = math.fsum(weight)
    x_mean, row_mean = math.fsum(weight * x) / total, math.fsum(weight * rows) / total
    u, v = (x - x_mean) / sigma, (rows - row_mean) / sigma
    length = math.sqrt(math.fsum(u * u))
    product = math.fsum((u / length) * v) / length
    # What rounding left in the means comes back through the mean residual.
    rest = math.fsum(weight * (rows - row_mean - product * (x - x_mean))) / total
    return _model(design, {
        "k_prime_px": product / design.k_mm,
        "b_prime_px": product * x_mean - row_mean - rest,
    })  # fmt: skip


def _search(
    rows: Array,
    ranges: Array,
    sigma: Array,
    start: RangeModel,
    design: RangeModel,
    names: tuple[str, ...],
    priors: dict[str, float],
) -> RangeModel:
    centre = np.array([getattr(design, name) for name in priors])
    spread = np.array(list(priors.values()))
    which = [names.index(name) for name in priors]
    straight = _Straightened(names, design, float(np.mean(ranges)))

    def residual(searched: Array) -> Array | None:
        values = straight.parameters(searched)
        p = {name: getattr(design, name) for name in PARAMETERS} | straight.named(values)
        depth = ranges + p["b_mm"]
        signs = p["k_mm"] > 0.0 > p["k_prime_px"] and p["b_prime_px"] <= -POLE_MARGIN_PX
        if not (signs and depth.min() > 0.0):
            return None
        fitted = p["k_mm"] * p["k_prime_px"] / depth - p["b_prime_px"]
        return np.concatenate([(fitted - rows) / sigma, (values[which] - centre) / spread])

    def jacobian(searched: Array) -> Array:
        model = _model(design, straight.named(straight.parameters(searched)))
        direct = _jacobian(model, ranges, sigma, names, priors)
        return np.asarray(direct @ straight.derivative(searched))

    begin = straight.searched(start)
    size = float(np.linalg.norm(rows / sigma)) + math.sqrt(rows.size)
    found = minimise(begin, residual, jacobian, size)
    if found is None:
        condition = condition_number(jacobian(begin))
        raise FitError(
            f"the search for {', '.join(names)} does not end (condition number {condition:.3g}); "
            "add targets at other ranges or a prior_sigma"
        )
    return _model(design, straight.named(straight.parameters(found)))


class _Straightened:
    """Parameters in which the valley of the sum of squares is straight.

    With b free, k' and b' are searched as slope and height of the curve in the middle of the
    targets: then b is its curvature alone. Otherwise the parameters are searched as they are.
    """

    def __init__(self, names: tuple[str, ...], design: RangeModel, middle_mm: float) -> None:
        self._names, self._design, self._middle_mm = names, design, middle_mm
        self._active = {"k_prime_px", "b_mm", "b_prime_px"} <= set(names)

    def named(self, values: Array) -> dict[str, float]:
        return dict(zip(self._names, values.tolist(), strict=True))

    def searched(self, model: RangeModel) -> Array:
        values = {name: getattr(model, name) for name in self._names}
        if self._active:
            values["b_prime_px"] = float(model.row(self._middle_mm))
            values["k_prime_px"] = 1.0 / float(model.range_per_row_mm(self._middle_mm))
        return np.array(list(values.values()))

    def parameters(self, searched: Array) -> Array:
        if not self._active:
            return searched
        p = self.named(searched)
        depth, slope = self._middle_mm + p["b_mm"], p["k_prime_px"]
        p["k_prime_px"] = -slope * depth * depth / p.get("k_mm", self._design.k_mm)
        p["b_prime_px"] = -slope * depth - p["b_prime_px"]
        return np.array(list(p.values()))

    def derivative(self, searched: Array) -> Array:
        """Parameters (rows) by searched ones (columns)."""
        matrix = np.eye(len(self._names))
        if not self._active:
            return matrix
        p = self.named(searched)
        depth, slope = self._middle_mm + p["b_mm"], p["k_prime_px"]
        k_mm = p.get("k_mm", self._design.k_mm)
        at = {name: index for index, name in enumerate(self._names)}
        k_prime, b_prime, b = at["k_prime_px"], at["b_prime_px"], at["b_mm"]
        matrix[k_prime, k_prime] = -depth * depth / k_mm
        matrix[k_prime, b] = -2.0 * slope * depth / k_mm
        if "k_mm" in at:
            matrix[k_prime, at["k_mm"]] = slope * (depth / k_mm) ** 2
        matrix[b_prime, k_prime], matrix[b_prime, b], matrix[b_prime, b_prime] = (
            -depth,
            -slope,
            -1.0,
        )
        return matrix


def _model(design: RangeModel, values: dict[str, Any]) -> RangeModel:
    try:
        return replace(design, **values)
    except ArgumentError as error:
        raise FitError(f"the targets lead to no possible build: {error}; check them") from error


def _jacobian(
    model: RangeModel,
    ranges: Array,
    sigma: Array,
    names: tuple[str, ...],
    priors: Mapping[str, float],
) -> Array:
    """Rows for targets, then for priors, each over its standard deviation."""
    targets = row_jacobian(model, ranges + model.b_mm, names) / sigma[:, None]
    held = np.zeros((len(priors), len(names)))
    for index, (name, spread) in enumerate(priors.items()):
        held[index, names.index(name)] = 1.0 / spread
    return np.concatenate([targets, held])


def _result(
    rows: Array,
    ranges: Array,
    sigma: Array,
    model: RangeModel,
    design: RangeModel,
    names: tuple[str, ...],
    priors: dict[str, float],
) -> CalibrationFit:
    jacobian = _jacobian(model, ranges, sigma, names, priors)
    condition = condition_number(jacobian)
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
        covariance(jacobian),
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
    condition = condition_number(_jacobian(model, ranges, sigma, names, priors))
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
    names = (free,) if isinstance(free, str) else tuple(free)
    if not names or len(set(names)) != len(names) or not set(names) <= set(PARAMETERS):
        raise ArgumentError(f"free is {free!r}; name each once, of {', '.join(PARAMETERS)}")
    return names


def _check_priors(priors: Mapping[str, float], names: tuple[str, ...]) -> None:
    for name, spread in priors.items():
        if name not in names:
            raise ArgumentError(f"prior_sigma names {name!r}; free is {', '.join(names)}")
        if not 0.0 < spread < math.inf:
            raise ArgumentError(f"prior_sigma of {name} is {spread!r}; choose a positive number")


def _spread(name: str, value: ArrayLike, size: int, *, zero_allowed: bool) -> Array:
    array = vector(name, np.broadcast_to(value, size) if np.ndim(value) == 0 else value)
    if array.size != size:
        raise ArgumentError(f"{name} has {array.size} entries; give one or {size}")
    wrong = array < 0.0 if zero_allowed else array <= 0.0
    if wrong.any():
        least = "0 or more" if zero_allowed else "a positive number"
        raise ArgumentError(f"{name} is {array[wrong][0]:g}; choose {least}")
    return array
