"""Solving Eq. 2 for its parameters: closed form where it is linear, damped search where not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core._least_squares import condition_number, minimise
from eschorty_ros.core.errors import ArgumentError, FitError
from eschorty_ros.core.optics import POLE_MARGIN_PX, RangeModel

Array = NDArray[np.float64]

PARAMETERS = ("k_mm", "k_prime_px", "b_mm", "b_prime_px")


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


def jacobian(
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


def straight_line(rows: Array, ranges: Array, sigma: Array, design: RangeModel) -> RangeModel:
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
    return build(design, {
        "k_prime_px": product / design.k_mm,
        "b_prime_px": product * x_mean - row_mean - rest,
    })  # fmt: skip


def search(
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

    def derivative(searched: Array) -> Array:
        model = build(design, straight.named(straight.parameters(searched)))
        direct = jacobian(model, ranges, sigma, names, priors)
        return np.asarray(direct @ straight.derivative(searched))

    begin = straight.searched(start)
    size = float(np.linalg.norm(rows / sigma)) + math.sqrt(rows.size)
    found = minimise(begin, residual, derivative, size)
    if found is None:
        condition = condition_number(derivative(begin))
        raise FitError(
            f"the search for {', '.join(names)} does not end (condition number {condition:.3g}); "
            "add targets at other ranges or a prior_sigma"
        )
    return build(design, straight.named(straight.parameters(found)))


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


def build(design: RangeModel, values: dict[str, Any]) -> RangeModel:
    try:
        return replace(design, **values)
    except ArgumentError as error:
        raise FitError(f"the targets lead to no possible build: {error}; check them") from error
