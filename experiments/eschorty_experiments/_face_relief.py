"""Relief of the scanned face: measured over true heights of nose and ears."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_experiments._scan_errors import ScanErrors
from eschorty_ros.core.reconstruction import Result
from eschorty_ros.simulation.scenes import EAR_OFF_MM, Face


def face_relief(scene: Face, result: Result, errors: ScanErrors) -> tuple[float, float]:
    """Return measured over true height of the nose over the cheeks, and of the cheeks over ears."""
    points = result.points
    across = np.abs(points["y"] * 1e3 - scene.centre_stage_mm)
    up = points["z"] * 1e3
    measured_mm = result.profiles.range_mm
    truth_mm = measured_mm - errors.error_mm
    nose = (across < 5.0) & (np.abs(up + 12.0) < 5.0)
    cheek = (np.abs(across - 42.0) < 6.0) & (np.abs(up + 8.0) < 6.0)
    ear = (np.abs(across - EAR_OFF_MM) < 10.0) & (truth_mm > scene.centre_mm + 85.0)

    def step(near: NDArray[np.bool_], far: NDArray[np.bool_]) -> float:
        if not near.any() or not far.any():
            return float("nan")
        measured, true = (
            np.median(range_mm[far]) - np.median(range_mm[near])
            for range_mm in (measured_mm, truth_mm)
        )
        return float(measured / true)

    return step(nose, cheek), step(cheek, ear)
