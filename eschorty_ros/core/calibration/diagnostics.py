"""Diagnostics of a fit: leave-one-out, profile of k, share of the priors, verdicts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import FitError
from eschorty_ros.core.calibration.fit import (
    CONDITION_WARNING,
    PRIOR_SIGMA,
    CalibrationFit,
    fit,
    solve,
)
from eschorty_ros.core.calibration.residuals import (
    COLUMN_TERMS,
    WIDTH_BIAS,
    Observed,
    Problem,
    covariance,
)
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import RangeModel

IDENTIFIABLE = "identifiable"
"""Verdict where the targets determine the build, and nothing speaks against the fit."""
LISTED = 4
"""Targets that a verdict names."""
# Above this ratio of standard deviations a prior determines more than the targets.
_PRIOR_SHARE = math.sqrt(0.5)
_RESIDUAL_SIGMA = 3.0
_MARGIN = 0.05
_FAR_SHARE = 0.25
# Share of Gaussian errors beyond three sigma.
_SHARE_BEYOND = 0.0027
_PROFILE_POINTS = 41
_PROFILE_SIGMA = 4.0
_CHI_SQUARE_95 = 3.841
# A fit in a thousand has a larger chi-square.
_RARE = 1e-3
_FREE_THEM = "fit " + " and ".join(COLUMN_TERMS) + ", too (--free)"
# Times that sigma may be wider with roll and smile free.
_ROLL_WIDENS = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class KProfile:
    """Profile likelihood of k: every other parameter at its best for each k."""

    k_mm: Array
    """Shape (n,)."""
    delta_chi_square: Array
    """Shape (n,). Above the smallest; the prior on k is left out, the others count."""
    interval_mm: tuple[float, float]
    """95 % interval; infinite on a side where it ends beyond the profile."""


def k_profile(targets: Targets, design: RangeModel, found: CalibrationFit) -> KProfile | None:
    """Return the profile likelihood of k within four standard deviations.

    ``None`` when k was fixed, or the other parameters are not determined for any k.
    """
    if "k_mm" not in found.free:
        return None
    half = _PROFILE_SIGMA * found.sigmas["k_mm"]
    # At a k of 0 or less there is no build.
    low = max(found.model.k_mm - half, 0.1 * found.model.k_mm)
    k_mm = np.linspace(low, found.model.k_mm + half, _PROFILE_POINTS)
    free = tuple(name for name in found.free if name != "k_mm")
    priors = {name: value for name, value in found.prior_sigma.items() if name != "k_mm"}
    chi_square = np.full(k_mm.size, np.nan)
    observed = Observed.of(targets, design, found.free)
    for index, value in enumerate(k_mm.tolist()):
        try:
            problem, values = solve(observed, replace(design, k_mm=value), free, priors)
        except FitError:
            continue
        white = problem.residual(problem.free(values))
        chi_square[index] = np.nan if white is None else white @ white
    if np.isnan(chi_square).all():
        return None
    delta = chi_square - np.nanmin(chi_square)
    return KProfile(k_mm, delta, _interval(k_mm, delta))


def _interval(k_mm: Array, delta: Array) -> tuple[float, float]:
    """Return where the profile crosses its 95 % level below and above its minimum."""
    best = int(np.nanargmin(delta))
    ends = []
    for side, open_end in (
        (np.arange(best, -1, -1), -math.inf),
        (np.arange(best, k_mm.size), math.inf),
    ):
        above = np.flatnonzero(delta[side] > _CHI_SQUARE_95)
        if above.size:
            crossing = side[above[0] - 1 : above[0] + 1]
            ends.append(float(np.interp(_CHI_SQUARE_95, delta[crossing], k_mm[crossing])))
        else:
            ends.append(open_end)
    return ends[0], ends[1]


def leave_one_out_px(targets: Targets, design: RangeModel, found: CalibrationFit) -> Array:
    """Return the row of each target minus the row that the others predict, shape (n,).

    It is calculated from the leverage of each target, which is exact for a linear model. NaN where
    the others do not determine the parameters.
    """
    observed = Observed.of(targets, design, found.free)
    problem = Problem(observed, design, found.free, found.prior_sigma, found.values)
    white = problem.whitened(found.values)
    # Without the error that all ranges share: it moves the others as much.
    own = covariance(problem.jacobian(problem.free(found.values)))
    left = np.eye(white.shape[1]) - problem.leverage(found.values, own)
    alone = np.linalg.eigvalsh(left)[:, 0] < 1e-9
    left[alone] = np.eye(white.shape[1])
    without = np.linalg.solve(left, white[:, :, None])
    rows = np.einsum("nij,njk->nik", problem.root, without)[:, 0, 0]
    return np.where(alone, np.nan, rows)


def prior_ratios(found: CalibrationFit) -> dict[str, float]:
    """Return posterior over prior standard deviation of each parameter that has a prior."""
    return {name: found.sigmas[name] / spread for name, spread in found.prior_sigma.items()}


def verdicts(targets: Targets, design: RangeModel, found: CalibrationFit) -> tuple[str, ...]:
    """Return ``identifiable`` where it applies, then each reservation with its remedy."""
    ratios = prior_ratios(found)
    held = {name: ratio for name, ratio in ratios.items() if ratio > _PRIOR_SHARE}
    # Ranges within those of targets that are far apart hardly depend on b.
    harmless = {"b_mm"} if np.ptp(targets.row) > 0.5 * design.rows else set()
    lines = [
        f"prior dominates {name}: the targets narrow it only to {ratio:.2f} of its prior "
        f"sigma of {found.prior_sigma[name]:g}"
        + ("; usual, and ranges hardly depend on it" if name in harmless else _remedy(name))
        for name, ratio in held.items()
    ]
    doubts = [*_pulled(design, found), *_sizes(targets, design, found)]
    coverage, misfits = _coverage(targets, found), _residuals(targets, found)
    freed = _with_roll(targets, design, found)
    if freed is not None:
        rolled = _rolled(found, freed)
        doubts += rolled
        coverage += [] if rolled else _roll_left_out(targets, found, freed)
    determined = found.condition_number <= CONDITION_WARNING and found.dof > 0
    if determined and not (set(held) - harmless or doubts or misfits):
        lines.insert(0, IDENTIFIABLE)
    return (*lines, *found.verdicts, *doubts, *coverage, *misfits)


def _pulled(design: RangeModel, found: CalibrationFit) -> list[str]:
    """Return a line for each parameter far from its design."""
    lines = []
    for name, spread in found.prior_sigma.items():
        pull = (found.values[name] - getattr(design, name, 0.0)) / spread
        if abs(pull) > _RESIDUAL_SIGMA:
            lines.append(
                f"{name} is {abs(pull):.1f} prior sigmas from the design; check the nominal "
                "build or widen its prior"
            )
    return lines


def _with_roll(
    targets: Targets, design: RangeModel, found: CalibrationFit
) -> CalibrationFit | None:
    """Return the fit with roll and smile free; ``None`` where they are, or columns are unknown."""
    if np.isnan(targets.column).any() or set(COLUMN_TERMS) & set(found.free):
        return None
    priors = found.prior_sigma | {name: PRIOR_SIGMA[name] for name in COLUMN_TERMS}
    try:
        return fit(targets, design, [*found.free, *COLUMN_TERMS], prior_sigma=priors)
    except FitError:
        return None


def _rolled(found: CalibrationFit, freed: CalibrationFit) -> list[str]:
    """Return a line where roll and smile explain residuals."""
    from scipy.special import chdtrc

    if chdtrc(2, found.chi_square - freed.chi_square) >= _RARE:
        return []
    values = ", ".join(
        f"{name} {freed.values[name]:+.1f} px with a sigma of {freed.sigmas[name]:.1f}"
        for name in COLUMN_TERMS
    )
    return [f"the sensor is rolled, or the line bent: {values} explain residuals; {_FREE_THEM}"]


def _roll_left_out(targets: Targets, found: CalibrationFit, freed: CalibrationFit) -> list[str]:
    """Return a line where roll and smile within their priors would widen sigma.

    Targets in the order of their ranges across the columns look the same on a sensor that is
    rolled.
    """
    ends_mm = np.array([[targets.range_mm.min()], [targets.range_mm.max()]])
    columns = np.array([0.0, found.model.principal_column, found.model.columns - 1.0])
    fixed_mm, freed_mm = (each.range_sigma_mm(ends_mm, columns) for each in (found, freed))
    worst = np.unravel_index(np.argmax(freed_mm / fixed_mm), freed_mm.shape)
    if freed_mm[worst] <= _ROLL_WIDENS * fixed_mm[worst]:
        return []
    return [
        f"sigma leaves out roll and smile: with them free it is {freed_mm[worst]:.2g} mm at "
        f"{ends_mm[worst[0], 0]:.0f} mm in column {columns[worst[1]]:.0f} instead of "
        f"{fixed_mm[worst]:.2g}; mix the ranges over all columns, or {_FREE_THEM}"
    ]


def _remedy(name: str) -> str:
    if name in ("k_mm", WIDTH_BIAS):
        return "; add targets of another size, or spacings"
    if name in COLUMN_TERMS:
        return "; spread the targets over the columns"
    return "; spread the targets over the range"


def _sizes(targets: Targets, design: RangeModel, found: CalibrationFit) -> list[str]:
    """Return a line when known sizes contradict a k that was fixed at its design value."""
    if "k_mm" in found.free or not targets.lateral:
        return []
    names, priors = ["k_mm", *found.free], dict(found.prior_sigma)
    if targets.has_width.any() and WIDTH_BIAS not in names:
        names.append(WIDTH_BIAS)
        priors[WIDTH_BIAS] = PRIOR_SIGMA[WIDTH_BIAS]
    try:
        freed = fit(targets, design, names, prior_sigma=priors)
    except FitError:
        return []
    k_mm, sigma = freed.model.k_mm, freed.sigmas["k_mm"]
    away = abs(k_mm - design.k_mm) / sigma
    if away <= _RESIDUAL_SIGMA:
        return []
    return [
        f"sizes contradict k_mm: they give {k_mm:.3f} with a sigma of {sigma:.3f}, "
        f"{away:.1f} sigma from its fixed value {design.k_mm:.3f}; method joint fits it"
    ]


def _coverage(targets: Targets, found: CalibrationFit) -> list[str]:
    """Return lines about ranges that the targets do not cover or cover too thinly."""
    model, lines = found.model, []
    near, far = model.range_limits_mm
    first, last = float(targets.row.min()), float(targets.row.max())
    margin = _MARGIN * model.rows
    if first > margin or last < model.rows - 1 - margin:
        if math.isfinite(far):
            worst = found.range_sigma_mm([near, far]).max()
            covered = f"{near:.0f} to {far:.0f} mm, where sigma grows to {worst:.2g} mm"
        else:
            covered = f"{near:.0f} mm to infinity, where sigma grows without limit"
        lines.append(
            f"extrapolates outside {targets.range_mm.min():.0f} to {targets.range_mm.max():.0f} mm "
            f"(rows {first:.0f} to {last:.0f}): the sensor covers {covered}"
        )
    third = near + (far - near) * 2.0 / 3.0
    beyond = int((targets.range_mm >= third).sum())
    if math.isfinite(third) and beyond < _FAR_SHARE * len(targets):
        lines.append(
            f"{beyond} of {len(targets)} targets are in the far third, beyond {third:.0f} mm; put "
            "at least a third of them there"
        )
    return lines


def _residuals(targets: Targets, found: CalibrationFit) -> list[str]:
    from scipy.special import chdtrc

    lines = []
    if found.dof and chdtrc(found.dof, found.chi_square) < _RARE:
        lines.append(
            f"residuals exceed the stated sigmas: reduced chi-square "
            f"{found.reduced_chi_square:.2f} with {found.dof} degrees of freedom; check the "
            f"targets, or state sigmas {math.sqrt(found.reduced_chi_square):.1f} times larger"
        )
    ratio = np.abs(found.residual_px) / found.sigma_px
    beyond = np.flatnonzero(ratio > _RESIDUAL_SIGMA)
    by_chance = _SHARE_BEYOND * len(targets)
    if beyond.size > by_chance + _RESIDUAL_SIGMA * math.sqrt(by_chance):
        worst = beyond[np.argsort(-ratio[beyond], kind="stable")][:LISTED].tolist()
        each = [
            f"{targets.labels[i]} {found.residual_px[i]:+.2f} px = {ratio[i]:.1f} sigma"
            for i in worst
        ]
        lines.append(
            f"{beyond.size} of {len(targets)} targets have residuals beyond {_RESIDUAL_SIGMA:g} "
            f"sigma: {listed(each, beyond.size)}; measure them again"
        )
    return lines


def listed(first: list[str], count: int) -> str:
    """Return ``first`` in one line, and how many more there are."""
    rest = count - len(first)
    return ", ".join(first) + (f" and {rest} more" if rest else "")
