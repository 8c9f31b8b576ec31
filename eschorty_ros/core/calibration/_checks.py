"""Targets and choices that no fit can make sense of, each refused with its cause and remedy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from eschorty_ros.core.base.arrays import positive
from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration._model import COLUMN_TERMS, EVERY, WIDTH_BIAS
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import RangeModel

_CONTRADICTION_SIGMA = 6.0


def refuse_unknowable(targets: Targets, names: tuple[str, ...]) -> None:
    distinct = np.unique(targets.range_mm).size
    if distinct < 2:
        raise FitError(
            f"range_mm holds {distinct} different ranges (condition number inf); give targets at "
            "2 different ranges or more"
        )
    if set(names) == {WIDTH_BIAS}:
        raise ArgumentError(
            f"free is {WIDTH_BIAS} alone, which is no part of a build; add parameters"
        )
    if {"k_mm", "k_prime_px"} <= set(names) and not targets.lateral:
        raise FitError(
            "k_mm and k_prime_px are both free without sizes (condition number inf): ranges show "
            "only their product; give sizes or spacings of targets, or fix k_mm"
        )
    if WIDTH_BIAS in names and not targets.has_width.any():
        raise FitError(
            f"{WIDTH_BIAS} is free without sizes (condition number inf); give width_px and size_mm "
            "of targets, or fix it"
        )


def refuse_pairs(targets: Targets, design: RangeModel) -> None:
    """Neighbours in range, then in row: the same target twice, or two that exclude each other."""
    place = np.nan_to_num(targets.column, nan=-1.0)
    rows_per_mm = -design.product_mm_px / (targets.range_mm + design.b_mm) ** 2
    sigma = np.hypot(targets.sigma_row_px, rows_per_mm * targets.sigma_range_mm)
    for same, other in (("range_mm", "row"), ("row", "range_mm")):
        order = np.lexsort((getattr(targets, other), place, getattr(targets, same)))
        one, next_one = order[:-1], order[1:]
        twin = (getattr(targets, same)[one] == getattr(targets, same)[next_one]) & (
            place[one] == place[next_one]
        )
        for i, j in zip(one[twin], next_one[twin], strict=True):
            apart = abs(targets.row[i] - targets.row[j]) + rows_per_mm[i] * abs(
                targets.range_mm[i] - targets.range_mm[j]
            )
            pair = f"targets {targets.labels[i]} and {targets.labels[j]}"
            where = f"row {targets.row[i]:g} and range_mm {targets.range_mm[i]:g}"
            if apart == 0.0:
                raise ArgumentError(f"{pair} are the same, {where}; remove one")
            if apart > _CONTRADICTION_SIGMA * math.hypot(sigma[i], sigma[j]):
                raise FitError(
                    f"{pair} contradict each other: {where} against row {targets.row[j]:g} and "
                    f"range_mm {targets.range_mm[j]:g}, {apart:.1f} px apart; correct one"
                )


def check_targets(targets: Targets, design: RangeModel, names: tuple[str, ...]) -> None:
    if not len(targets):
        raise FitError("there are 0 targets (condition number inf); give targets at known ranges")
    off = (targets.row < -0.5) | (targets.row > design.rows - 0.5)
    if off.any():
        at = int(np.flatnonzero(off)[0])
        raise ArgumentError(
            f"row of target {targets.labels[at]} is {targets.row[at]:g}; the sensor has rows 0 to "
            f"{design.rows - 1}"
        )
    behind = targets.range_mm + design.b_mm <= 0.0
    if behind.any():
        raise ArgumentError(
            f"range_mm is {targets.range_mm[behind][0]:g}; choose ranges beyond -b_mm = "
            f"{-design.b_mm:g} mm"
        )
    if set(COLUMN_TERMS) & set(names) and np.isnan(targets.column).any():
        at = int(np.flatnonzero(np.isnan(targets.column))[0])
        raise ArgumentError(
            f"column of target {targets.labels[at]} is unknown; give the column of every target "
            f"or fix {' and '.join(COLUMN_TERMS)}"
        )


def checked_free(free: Sequence[str]) -> tuple[str, ...]:
    names = tuple(free) if isinstance(free, list | tuple) else (free,)
    known = all(isinstance(name, str) and name in EVERY for name in names)
    if not (names and known and len(set(names)) == len(names)):
        raise ArgumentError(f"free is {free!r}; name each once, of {', '.join(EVERY)}")
    return names


def checked_priors(
    prior_sigma: Mapping[str, float] | None, names: tuple[str, ...]
) -> dict[str, float]:
    if not isinstance(prior_sigma, Mapping | None):
        raise ArgumentError(f"prior_sigma is {prior_sigma!r}; give a number for each name")
    priors = dict(prior_sigma or {})
    for name, spread in priors.items():
        if name not in names:
            raise ArgumentError(f"prior_sigma names {name!r}; free is {', '.join(names)}")
        if spread != math.inf:
            positive(f"prior_sigma of {name}", spread)
    return priors
