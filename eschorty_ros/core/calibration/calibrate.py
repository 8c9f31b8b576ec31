"""From targets to a calibration that says how good it is."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.calibration._checks import (
    check_targets,
    checked_free,
    checked_priors,
    refuse_pairs,
    refuse_unknowable,
)
from eschorty_ros.core.calibration._model import WIDTH_BIAS, Observed
from eschorty_ros.core.calibration._robust import TARGETS_MIN, inliers
from eschorty_ros.core.calibration.diagnostics import (
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
    fit,
)
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import Calibration, RangeModel

Method = Literal["paper", "joint"]

METHODS: tuple[Method, ...] = ("paper", "joint")
_CHANNELS = ("row", "width", "spacing")


@dataclass(frozen=True, slots=True)
class Rejected:
    """A target that no calibration used.

    Attributes
    ----------
    index : int
        Place among the targets given.
    label : str
    reason : str
    """

    index: int
    label: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationReport:
    """A calibration with everything that tells how far to trust it.

    Attributes
    ----------
    calibration : Calibration
        What the file holds.
    nominal : Calibration
        The design it started from.
    method : str
    targets : Targets
        All that were given; the arrays below are in their order, shape (n,).
    used : ndarray of bool
    fit : CalibrationFit
        On the targets used.
    residual_px : ndarray of float64
        Row as measured minus row as fitted.
    leave_one_out_px : ndarray of float64
        The same against the fit without that target; NaN where the others do not suffice.
    rejected : tuple of Rejected
    profile : KProfile or None
        Profile likelihood of k where k was fitted.
    prior_ratio : dict of str to float
        Posterior over prior standard deviation.
    verdicts : tuple of str
        ``identifiable`` where it is, then every reservation.
    """

    calibration: Calibration
    nominal: Calibration
    method: Method
    targets: Targets
    used: NDArray[np.bool_]
    fit: CalibrationFit
    residual_px: Array
    leave_one_out_px: Array
    rejected: tuple[Rejected, ...]
    profile: KProfile | None
    prior_ratio: dict[str, float]
    verdicts: tuple[str, ...]

    @property
    def residual_mm(self) -> Array:
        """Range as the fit reads it minus the known range, mm, shape (n,)."""
        return self.fit.model.range_mm(self.targets.row, self._column) - self.targets.range_mm

    def range_sigma_mm(
        self, row: ArrayLike, sigma_row: ArrayLike = 0.0, column: ArrayLike | None = None
    ) -> Array:
        """Give the standard deviation of a range by its row, mm: fit and centroid together."""
        model = self.fit.model
        own = self.fit.range_sigma_mm(model.range_mm(row, column), column)
        return np.hypot(own, model.range_sigma_mm(row, sigma_row, column))

    @property
    def _column(self) -> Array:
        """Where the targets stand; the principal column where unknown."""
        return np.nan_to_num(self.targets.column, nan=self.fit.model.principal_column)


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
    """Fit a build to targets and judge the result.

    Parameters
    ----------
    targets : Targets
        At two different ranges or more.
    nominal : Calibration
        The design: fixed parameters, centres of the priors, geometry.
    method : {"joint", "paper"}
        ``paper`` fits k' and b' by plain least squares, k and b stay as designed. ``joint`` fits
        k', b and b', with known sizes or spacings also k and the width bias, under priors.
    free : sequence of str, optional
        Parameters of the joint fit instead of these.
    prior_sigma : mapping of str to float, optional
        Standard deviations instead of `PRIOR_SIGMA`, for parameters that are free; infinity for
        no prior.
    robust : bool, optional
        Whether targets that do not follow the curve are found and left out; needs five targets.
        By default with ``joint`` alone.
    date : str, optional
        ISO date for the file.

    Returns
    -------
    CalibrationReport

    Raises
    ------
    ArgumentError
        When an argument is out of bounds, a target off the sensor, or two targets are the same.
    FitError
        When the targets do not determine the parameters or contradict each other.
    """
    design = nominal.model()
    names = checked_free(_free(method, free, targets))
    priors = _priors(method, prior_sigma, names, design)
    check_targets(targets, design, names)
    refuse_pairs(targets, design)
    refuse_unknowable(targets, names)
    used = np.ones(len(targets), dtype=bool)
    rejected: tuple[Rejected, ...] = ()
    if _wants_rejection(method, robust, len(targets)):
        used, rejected = _rejection(targets, design, names, priors)
    kept = targets.select(used)
    found = fit(kept, design, names, prior_sigma=priors)
    said = verdicts(kept, design, found)
    if rejected:
        names_left_out = listed([entry.label for entry in rejected[:LISTED]], len(rejected))
        said = (*said, f"{len(rejected)} of {len(targets)} targets rejected: {names_left_out}")
    residual, alone = _residuals(targets, used, design, found)
    return CalibrationReport(
        calibration=_calibration(nominal, found, kept, method, date),
        nominal=nominal,
        method=method,
        targets=targets,
        used=used,
        fit=found,
        residual_px=residual,
        leave_one_out_px=alone,
        rejected=rejected,
        profile=k_profile(kept, design, found),
        prior_ratio=prior_ratios(found),
        verdicts=said,
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
            raise ArgumentError("method paper knows no prior_sigma; choose joint or leave it out")
        return {}
    known = {"k_mm": K_PRIOR_SHARE * design.k_mm, **PRIOR_SIGMA}
    priors = {name: known[name] for name in names} | checked_priors(prior_sigma, names)
    return {name: spread for name, spread in priors.items() if spread != math.inf}


def _wants_rejection(method: Method, robust: bool | None, size: int) -> bool:
    if robust and size < TARGETS_MIN:
        raise ArgumentError(
            f"robust is True with {size} targets; give {TARGETS_MIN} or more, or leave it out"
        )
    return robust if robust is not None else method == "joint" and size >= TARGETS_MIN


def _rejection(
    targets: Targets, design: RangeModel, names: tuple[str, ...], priors: Mapping[str, float]
) -> tuple[NDArray[np.bool_], tuple[Rejected, ...]]:
    observed = Observed.of(targets, design)
    if not {"k_mm", WIDTH_BIAS} & set(names):
        observed = observed.rows_only()
    kept, distance = inliers(observed, design, names, priors)
    rejected = []
    for index in np.flatnonzero(~kept).tolist():
        channel = int(np.argmax(np.abs(distance[index])))
        rejected.append(
            Rejected(
                index,
                targets.labels[index],
                f"{_CHANNELS[channel]} {observed.seen[index, channel]:.1f} px at "
                f"{targets.range_mm[index]:.0f} mm lies {abs(distance[index, channel]):.1f} sigma "
                "from the curve of the others",
            )
        )
    return kept, tuple(rejected)


def _residuals(
    targets: Targets, used: NDArray[np.bool_], design: RangeModel, found: CalibrationFit
) -> tuple[Array, Array]:
    seen = Observed.of(targets, design).residual(found.values)
    # A target that was left out lies in front of the focal line of the others' curve.
    residual = np.full(len(targets), np.nan) if seen is None else seen[:, 0]
    alone = residual.copy()
    alone[used] = leave_one_out_px(targets.select(used), design, found)
    return residual, alone


def _calibration(
    nominal: Calibration, found: CalibrationFit, kept: Targets, method: Method, date: str | None
) -> Calibration:
    """Design with the fitted parameters; the width bias belongs to the targets, not to a build."""
    fitted = [name for name in found.free if name != WIDTH_BIAS]
    at = [found.free.index(name) for name in fitted]
    matrix = found.covariance[np.ix_(at, at)]
    matrix = 0.5 * (matrix + matrix.T)
    values = {name: found.values[name] for name in fitted}
    digest = hashlib.sha256(
        repr((nominal.name, method, sorted(values.items()), kept.row.tolist(),
              kept.range_mm.tolist())).encode()
    )  # fmt: skip
    parts = (nominal.name, *((date,) if date else ()), digest.hexdigest()[:8])
    data = nominal.model_dump() | values | {
        "id": "-".join(parts),
        "date": date,
        "parameters_fitted": tuple(fitted),
        "covariance": tuple(tuple(row) for row in matrix.tolist()),
        "residual_rms_px": float(np.sqrt(np.mean(found.residual_px**2))),
        "condition_number": found.condition_number,
        "range_mm": (float(kept.range_mm.min()), float(kept.range_mm.max())),
    }  # fmt: skip
    return Calibration.model_validate(data)
