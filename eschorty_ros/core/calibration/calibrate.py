"""From targets to a calibration with its diagnostics."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration.diagnostics import (
    IDENTIFIABLE,
    LISTED,
    KProfile,
    k_profile,
    leave_one_out_px,
    listed,
    prior_ratios,
    verdicts,
)
from eschorty_ros.core.calibration.fit import (
    K_PRIOR_SHARE,
    PAPER_FREE,
    PRIOR_SIGMA,
    CalibrationFit,
    check_targets,
    checked_free,
    checked_priors,
    fit,
)
from eschorty_ros.core.calibration.residuals import WIDTH_BIAS, Observed
from eschorty_ros.core.calibration.robust import SCALE_MAX, contradicted, inliers
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import Calibration, RangeModel

Method = Literal["paper", "joint"]

METHODS: tuple[Method, ...] = ("paper", "joint")
# Among fewer targets an outlier cannot be identified.
_ROBUST_TARGETS_MIN = 5
_CONTRADICTION_SIGMA = 6.0
# Standard deviation of k' over k'.
_SLOPE_SIGMA_MAX = 1 / 3
# Ranges that differ by less are one range within their errors.
_SPAN_SIGMAS = 3.0
_CHANNELS = ("row", "width", "spacing")
# Residual that no stated sigma explains: half of a line's width.
_MISFIT_PX = 10.0
# Correlation of rows with range beyond which their sense is no error of some.
_MIRRORED = 0.9
# Times that a range may be outside those of the design: centimetres are ten times nearer, and the
# farthest range of a build is seldom more than three times its nearest.
_OTHER_UNIT = 3.0


@dataclass(frozen=True, slots=True)
class Rejected:
    """A target that the fit left out."""

    index: int
    """Index among the targets given."""
    label: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationReport:
    """A calibration with the diagnostics of its fit."""

    calibration: Calibration
    """Content of the file."""
    nominal: Calibration
    """The design it started from."""
    method: Method
    targets: Targets
    """All that were given; the arrays below are in their order, shape (n,)."""
    used: NDArray[np.bool_]
    fit: CalibrationFit
    """On the targets used."""
    residual_px: Array
    """Row as measured minus row as fitted."""
    leave_one_out_px: Array
    """The same against the fit without that target; NaN where the others do not suffice."""
    rejected: tuple[Rejected, ...]
    profile: KProfile | None
    """Profile likelihood of k where k was fitted."""
    prior_ratio: dict[str, float]
    """Posterior over prior standard deviation."""
    verdicts: tuple[str, ...]
    """``identifiable`` where it applies, then every reservation."""

    @property
    def identifiable(self) -> bool:
        """Return whether the targets determine the build, and nothing speaks against the fit."""
        return IDENTIFIABLE in self.verdicts

    @property
    def reservations(self) -> list[str]:
        """Return the other verdicts."""
        return [line for line in self.verdicts if line != IDENTIFIABLE]

    @property
    def residual_mm(self) -> Array:
        """Range by the fit minus the known range, mm, shape (n,)."""
        model = self.fit.model
        column = np.nan_to_num(self.targets.column, nan=model.principal_column)
        return model.range_mm(self.targets.row, column) - self.targets.range_mm

    def range_sigma_mm(
        self, row: ArrayLike, sigma_row: ArrayLike = 0.0, column: ArrayLike | None = None
    ) -> Array:
        """Return the standard deviation of a range by its row, mm: fit and centroid together."""
        model = self.fit.model
        own = self.fit.range_sigma_mm(model.range_mm(row, column), column)
        return np.hypot(own, model.range_sigma_mm(row, sigma_row, column))


def calibrate(
    targets: Targets,
    nominal: Calibration,
    method: Method = "joint",
    *,
    free: Sequence[str] | None = None,
    prior_sigma: Mapping[str, float] | None = None,
    robust: bool | None = None,
    date: str | None = None,
) -> CalibrationReport:
    """Return a build fitted to targets, with diagnostics of the fit.

    - ``targets``: At two different ranges or more.
    - ``nominal``: The design: fixed parameters, centres of the priors, geometry.
    - ``method``: ``paper`` fits k' and b' by plain least squares, k and b stay as designed.
      ``joint`` fits k', b and b', with known sizes or spacings also k and the
      width bias, under priors.
    - ``free``: Parameters of the joint fit instead of these.
    - ``prior_sigma``: Standard deviations instead of `PRIOR_SIGMA`, for parameters that are free;
      infinity for no prior.
    - ``robust``: Find targets that do not follow the curve and leave them out; needs five targets.
      By default with ``joint`` alone.
    - ``date``: ISO date for the file.

    Raises ``ArgumentError`` when an argument is out of bounds, a target off the sensor, or two
    targets are the same. Raises ``FitError`` when the targets do not determine the parameters or
    contradict each other.

    Examples
    --------
    >>> from eschorty_ros.core.calibration import Targets, calibrate
    >>> from eschorty_ros.core.optics import load_calibration
    >>> posts = Targets(row=[87.9, 246.1, 395.6, 545.0], range_mm=[850.0, 1000.0, 1200.0, 1500.0])
    >>> report = calibrate(posts, load_calibration("config_3"), "paper")
    >>> report.calibration.parameters_fitted
    ('k_prime_px', 'b_prime_px')
    >>> print(report.verdicts[0], report.range_sigma_mm(row=360.0, sigma_row=0.3).round(2))
    identifiable 0.49
    """
    design = nominal.model()
    names = checked_free(_free(method, free, targets))
    priors = _priors(method, prior_sigma, names, design)
    check_targets(targets, design, names)
    _refuse_units(targets, design)
    _refuse_mirrored(targets, design)
    _refuse_pairs(targets, design)
    _refuse_undetermined(targets, design, names)
    used = np.ones(len(targets), dtype=bool)
    rejected: tuple[Rejected, ...] = ()
    if _rejects_outliers(method, robust, len(targets)):
        used, rejected = _rejection(targets, design, names, priors)
    kept = targets.select(used)
    found = fit(kept, design, names, prior_sigma=priors)
    _refuse_unmoved(kept, design, found)
    _refuse_misfit(found)
    lines = verdicts(kept, design, found)
    if rejected:
        labels = listed([entry.label for entry in rejected[:LISTED]], len(rejected))
        lines = (*lines, f"{len(rejected)} of {len(targets)} targets rejected: {labels}")
    residual = Observed.of(targets, design, names).residual(found.values)
    # A rejected target may be in front of the focal line of the others' curve.
    residual_px = np.full(len(targets), np.nan) if residual is None else residual[:, 0]
    alone_px = residual_px.copy()
    alone_px[used] = leave_one_out_px(kept, design, found)
    return CalibrationReport(
        calibration=_calibration(nominal, found, kept, method, date),
        nominal=nominal,
        method=method,
        targets=targets,
        used=used,
        fit=found,
        residual_px=residual_px,
        leave_one_out_px=alone_px,
        rejected=rejected,
        profile=k_profile(kept, design, found),
        prior_ratio=prior_ratios(found),
        verdicts=lines,
    )


def _free(method: Method, free: Sequence[str] | None, targets: Targets) -> Sequence[str]:
    if method not in METHODS:
        raise ArgumentError(f"method is {method!r}; choose {' or '.join(METHODS)}")
    if method == "paper":
        if free is not None:
            raise ArgumentError("method paper fits k_prime_px and b_prime_px; leave free out")
        return PAPER_FREE
    if free is not None:
        return free
    names: tuple[str, ...] = ("k_prime_px", "b_mm", "b_prime_px")
    if targets.lateral:
        names = ("k_mm", *names)
    return (*names, WIDTH_BIAS) if targets.has_width.any() else names


def _priors(
    method: Method,
    prior_sigma: Mapping[str, float] | None,
    names: tuple[str, ...],
    design: RangeModel,
) -> dict[str, float]:
    if method == "paper":
        if prior_sigma:
            raise ArgumentError("method paper has no prior_sigma; choose joint or leave it out")
        return {}
    known = {"k_mm": K_PRIOR_SHARE * design.k_mm, **PRIOR_SIGMA}
    priors = {name: known[name] for name in names} | checked_priors(prior_sigma, names)
    return {name: spread for name, spread in priors.items() if spread != math.inf}


def _refuse_units(targets: Targets, design: RangeModel) -> None:
    """Refuse ranges in another unit."""
    near_mm, far_mm = design.range_limits_mm
    small, large = targets.range_mm < near_mm / _OTHER_UNIT, targets.range_mm > far_mm * _OTHER_UNIT
    wrong = np.flatnonzero(small | large)
    if wrong.size:
        raise ArgumentError(
            f"range_mm of target {targets.labels[wrong[0]]} is {targets.range_mm[wrong[0]]:g}; "
            f"give millimetres, {near_mm:.0f} to {far_mm:.0f} by the design"
        )


def _refuse_mirrored(targets: Targets, design: RangeModel) -> None:
    """Refuse rows that fall with range, which no sensor shows."""
    if np.ptp(targets.row) * np.ptp(targets.range_mm) == 0.0:
        return
    along = np.corrcoef(targets.row, -1.0 / (targets.range_mm + design.b_mm))[0, 1]
    if along < -_MIRRORED:
        near, far = (int(pick(targets.range_mm)) for pick in (np.argmin, np.argmax))
        raise FitError(
            f"rows fall with range, from {targets.row[near]:.1f} at {targets.range_mm[near]:g} mm "
            f"to {targets.row[far]:.1f} at {targets.range_mm[far]:g} mm: turn a camera "
            f"that is upside down; where rows are counted from the sensor's other end write "
            f"{design.rows - 1} - row, else correct the ranges"
        )


def _refuse_pairs(targets: Targets, design: RangeModel) -> None:
    """Refuse the same target twice, and two that exclude each other.

    Both are neighbours when the targets are sorted by range, then by row.
    """
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


def _refuse_undetermined(targets: Targets, design: RangeModel, names: tuple[str, ...]) -> None:
    distinct = np.unique(targets.range_mm).size
    if distinct < 2:
        raise FitError(
            f"range_mm holds {distinct} different ranges (condition number inf); give targets at "
            "2 different ranges or more"
        )
    # One target of a large error is no reason: the others determine the build.
    span, sigma = float(np.ptp(targets.range_mm)), float(np.median(targets.sigma_range_mm))
    if span < _SPAN_SIGMAS * sigma:
        raise FitError(
            f"the targets do not determine the build: their ranges differ by {span:g} mm and have "
            f"a sigma of {sigma:g} mm; give targets that move in range"
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


def _refuse_unmoved(kept: Targets, design: RangeModel, found: CalibrationFit) -> None:
    """Refuse targets whose rows do not move with their range as on a sensor."""
    model = found.model
    known = found.sigmas.get("k_prime_px", 0.0) < _SLOPE_SIGMA_MAX * -model.k_prime_px
    if known and model.tilt_sine < 1.0 and model.range_limits_mm[0] > 0.0:
        return
    low, high = kept.range_mm.min(), kept.range_mm.max()
    expected = float(design.row(high) - design.row(low))
    raise FitError(
        f"the targets do not determine the build: rows {kept.row.min():.1f} to "
        f"{kept.row.max():.1f} at {low:g} to {high:g} mm, a difference of {expected:.1f} px by the "
        f"design, would be k_prime_px = {model.k_prime_px:.4g}; give targets that move in range"
    )


def _refuse_misfit(found: CalibrationFit) -> None:
    """Refuse targets that are far from any curve; see `inliers` for those of more than four."""
    times = math.sqrt(found.reduced_chi_square) if found.dof else 0.0
    if times > SCALE_MAX and np.abs(found.residual_px).max() > _MISFIT_PX:
        raise FitError(
            f"the targets contradict {contradicted(found.free)}: they are {times:.0f} times "
            "farther from any curve than their sigmas allow; check row and range_mm of each"
        )


def _rejects_outliers(method: Method, robust: bool | None, size: int) -> bool:
    if robust and size < _ROBUST_TARGETS_MIN:
        raise ArgumentError(
            f"robust is True with {size} targets; give {_ROBUST_TARGETS_MIN} or more, or leave it "
            "out"
        )
    return robust if robust is not None else method == "joint" and size >= _ROBUST_TARGETS_MIN


def _rejection(
    targets: Targets, design: RangeModel, names: tuple[str, ...], priors: Mapping[str, float]
) -> tuple[NDArray[np.bool_], tuple[Rejected, ...]]:
    observed = Observed.of(targets, design, names)
    kept, distance = inliers(observed, design, names, priors)
    rejected = []
    for index in np.flatnonzero(~kept).tolist():
        channel = int(np.argmax(np.abs(distance[index])))
        rejected.append(
            Rejected(
                index,
                targets.labels[index],
                f"{_CHANNELS[channel]} {observed.measured[index, channel]:.1f} px at "
                f"{targets.range_mm[index]:.0f} mm is {abs(distance[index, channel]):.1f} sigma "
                "from the curve of the others",
            )
        )
    return kept, tuple(rejected)


def _calibration(
    nominal: Calibration, found: CalibrationFit, kept: Targets, method: Method, date: str | None
) -> Calibration:
    """Return the design with the fitted parameters.

    The width bias is left out: it is a property of the targets, not of a build.
    """
    fitted = [name for name in found.free if name != WIDTH_BIAS]
    at = [found.free.index(name) for name in fitted]
    matrix = found.covariance[np.ix_(at, at)]
    matrix = 0.5 * (matrix + matrix.T)
    values: dict[str, Any] = {name: found.values[name] for name in fitted}
    # In any order of the targets.
    rounded = sorted(f"{name} {value:.9g}" for name, value in values.items())
    rows, ranges = (sorted(each.tolist()) for each in (kept.row, kept.range_mm))
    digest = hashlib.sha256(repr((nominal.name, method, rounded, rows, ranges)).encode())
    parts = (nominal.name, *((date,) if date else ()), digest.hexdigest()[:8])
    return replace(
        nominal,
        id="-".join(parts),
        date=date,
        parameters_fitted=tuple(fitted),
        covariance=tuple(tuple(row) for row in matrix.tolist()),
        residual_rms_px=float(np.sqrt(np.mean(found.residual_px**2))),
        condition_number=found.condition_number,
        range_mm=(float(kept.range_mm.min()), float(kept.range_mm.max())),
        **values,
    )
