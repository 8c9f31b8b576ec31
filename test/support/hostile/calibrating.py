"""Fitting a build to targets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from eschorty_ros.core.calibration import calibrate, targets, targets_file
from eschorty_ros.core.calibration import fit as calibration_fit
from eschorty_ros.core.optics import calibration_file as calibration
from hostile.kinds import Call, Kind, number, path, reals, text, vector
from hostile.subjects import MODEL

ROWS, RANGES_MM = [100.0, 300.0, 500.0], [860.0, 1064.0, 1395.0]
SEEN = targets.Targets(ROWS, RANGES_MM)
NOMINAL = calibration.load_calibration("config_3")
SOME_FREE = Kind([3, "k", ["k_mm", "k_mm"], [], [3], [[]]])
FREE = Kind([None, *SOME_FREE.refused])
PRIORS = Kind([{"k_mm": 1.0}, {"k_prime_px": 0.0}, {"k_prime_px": "a"}, 3, "k_mm"])


def reading(read: Any, header: str) -> Any:
    """Read a small file of its own, or the path given."""

    def call(**arguments: Any) -> Any:
        Path("t.csv").write_text(header)
        return read(**arguments)

    return call


SIGMAS = {"sigma_row_px": number(0.0), "sigma_range_mm": number(-1.0)}
CALLS: dict[str, Call] = {
    "calibrate.calibrate": Call(
        calibrate.calibrate,
        {
            "targets": SEEN,
            "nominal": NOMINAL,
            "method": "joint",
            "free": ("k_prime_px", "b_prime_px"),
            "prior_sigma": None,
            "robust": False,
            "date": None,
        },
        {"method": text(), "free": SOME_FREE, "prior_sigma": PRIORS, "robust": Kind([True])},
    ),
    "calibrate.CalibrationReport.range_sigma_mm": Call(
        calibrate.calibrate(SEEN, NOMINAL).range_sigma_mm,
        {"row": [100.0], "sigma_row": [0.3], "column": [639.5]},
        {"row": reals(), "sigma_row": reals(), "column": reals(optional=True)},
    ),
    "calibration_fit.CalibrationFit.range_sigma_mm": Call(
        calibration_fit.fit(SEEN, MODEL).range_sigma_mm,
        {"range_mm": [900.0], "column": [639.5]},
        {"range_mm": reals(), "column": reals(optional=True)},
    ),
    "calibration_fit.fit": Call(
        calibration_fit.fit,
        {"targets": SEEN, "design": MODEL, "free": ("k_prime_px",), "prior_sigma": None},
        {"free": FREE, "prior_sigma": PRIORS},
    ),
    "calibration_fit.fit_targets": Call(
        calibration_fit.fit_targets,
        {
            "row": ROWS,
            "range_mm": RANGES_MM,
            "design": MODEL,
            "free": ("k_prime_px", "b_prime_px"),
            "sigma_row_px": 0.3,
            "sigma_range_mm": 0.0,
            "prior_sigma": None,
        },
        {
            "row": vector(-1.0, 720.0, size=3),
            "range_mm": vector(0.0, -5.0, size=3),
            "free": FREE,
            "sigma_row_px": vector(0.0, -1.0, size=3),
            "sigma_range_mm": vector(-1.0, size=3),
            "prior_sigma": PRIORS,
        },
    ),
    "targets_file.write_targets": Call(
        lambda path: targets_file.write_targets(path, SEEN), {"path": "t.csv"}, {"path": path()}
    ),
    "targets_file.read_targets": Call(
        reading(targets_file.read_targets, "row,range_mm\n100,900\n"),
        {"path": "t.csv", "sigma_row_px": 0.3, "sigma_range_mm": 1.0},
        {"path": path(), **SIGMAS},
    ),
    "targets_file.read_distances": Call(
        reading(targets_file.read_distances, "range_mm\n900\n"),
        {"path": "t.csv", "sigma_range_mm": 1.0},
        {"path": path(), "sigma_range_mm": number(-1.0)},
    ),
}
