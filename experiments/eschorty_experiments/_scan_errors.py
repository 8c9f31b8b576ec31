"""Points of a simulated recording against the truth: errors, gaps and gross errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction import Profiles
from eschorty_ros.core.storage import Recording
from eschorty_ros.report.accuracy import true_range_mm
from eschorty_ros.simulation.scenes import Scene

GROSS_PX = 10.0
"""Half the line's full width at half maximum: a row this far off is not on the line."""

RIM_MM = 3.0
"""Half the line's thickness along the stage at 1.3 m, and the stage's travel within a lit phase."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanErrors:
    """Errors of the points of one scan; arrays of shape (points,)."""

    error_mm: NDArray[np.float64]
    """Measured minus true range at each point's own stage position and column; NaN where the scene
    has no surface."""
    gross: NDArray[np.bool_]
    """More than ``GROSS_PX`` rows off, or where the scene has no surface."""
    inside: NDArray[np.bool_]
    """The surface continues for ``RIM_MM`` ahead and behind along the stage, so that the line's
    thickness is on one surface."""
    completeness: float
    """Share of the truth's periods and columns that have a point."""

    @property
    def median_mm(self) -> float:
        """Median absolute error."""
        return self.quantile_mm(0.5)

    @property
    def rmse_mm(self) -> float:
        """Root of the mean squared error, gross errors included; NaN without points."""
        known = self.error_mm[np.isfinite(self.error_mm)]
        return float(np.sqrt(np.mean(known * known))) if known.size else float("nan")

    @property
    def bias_mm(self) -> float:
        """Median of the signed error."""
        known = self.error_mm[np.isfinite(self.error_mm)]
        return float(np.median(known)) if known.size else float("nan")

    @property
    def gross_share(self) -> float:
        """Gross errors among all points; NaN without points."""
        return float(np.mean(self.gross)) if self.gross.size else float("nan")

    def away_from_rims(self) -> ScanErrors:
        """Return the points whose line is on one surface."""
        at = self.inside
        return ScanErrors(self.error_mm[at], self.gross[at], at[at], self.completeness)

    def quantile_mm(self, share: float) -> float:
        """Return a quantile of the absolute error; NaN without points."""
        size = np.abs(self.error_mm[np.isfinite(self.error_mm)])
        return float(np.quantile(size, share)) if size.size else float("nan")


def pooled(parts: Sequence[ScanErrors]) -> ScanErrors:
    """Return the points of several scans together; the completeness is the mean of theirs."""
    return ScanErrors(
        np.concatenate([part.error_mm for part in parts]),
        np.concatenate([part.gross for part in parts]),
        np.concatenate([part.inside for part in parts]),
        float(np.mean([part.completeness for part in parts])),
    )


def scan_errors(
    profiles: Profiles, recording: Recording, scene: Scene, every: int = 1
) -> ScanErrors:
    """Compare every point with the scene at its time, and the recording's truth with the points.

    - ``recording``: With its truth and its stage positions.
    - ``scene``: The recorded scene.
    - ``every``: Compare one of so many columns; the truth of all takes longer to compute than the
      scan.
    """
    model = recording.calibration.model()
    profiles = profiles.select(profiles.column % every == 0)
    stage_mm = np.asarray(recording.stage.position_mm(profiles.t_us))
    # At once: a scene takes about as long for three stage positions as for one.
    stages_mm = np.concatenate([stage_mm + off_mm for off_mm in (0.0, -RIM_MM, RIM_MM)])
    columns = np.tile(profiles.column, 3)
    truth_mm, *beside_mm = np.split(true_range_mm(scene, model, stages_mm, columns), 3)
    rows = model.row(truth_mm)
    inside = np.all([np.abs(model.row(mm) - rows) <= GROSS_PX for mm in beside_mm], axis=0)
    off_px = np.abs(profiles.row - rows)
    truth = recording.truth
    assert truth is not None, "a simulated recording has its truth"
    truth = truth[truth["column"] % every == 0]
    return ScanErrors(
        profiles.range_mm - truth_mm,
        ~(off_px <= GROSS_PX),
        inside,
        _completeness(profiles, truth, recording.modulation, model),
    )


def _completeness(
    profiles: Profiles, truth: NDArray[np.void], modulation: Modulation, model: RangeModel
) -> float:
    if len(truth) == 0:
        return float("nan")
    expected = _keys(period_of(truth["t_us"], modulation), truth["column"], model)
    found = _keys(period_of(profiles.t_us, modulation), profiles.column, model)
    return float(np.mean(np.isin(expected, found)))


def period_of(t_us: NDArray[np.int64], modulation: Modulation) -> NDArray[np.int64]:
    """Return the number of a time's modulation period, counted from the recorded rising edge."""
    since_us = t_us - (modulation.on_edge_us or 0)
    return np.floor(since_us / modulation.period_us).astype(np.int64)


def _keys(period: NDArray[np.int64], column: NDArray[Any], model: RangeModel) -> NDArray[np.int64]:
    return period * model.columns + column
