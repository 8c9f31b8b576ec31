"""Fitting a build to targets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from eschorty_ros.core import calibration
from eschorty_ros.core.optics import load_calibration
from hostile.kinds import Call, Kind, number, path, reals, text
from hostile.subjects import MODEL

ROWS, RANGES_MM = [100.0, 300.0, 500.0], [860.0, 1064.0, 1395.0]
SEEN = calibration.Targets(ROWS, RANGES_MM)
NOMINAL = load_calibration("config_3")
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
    "calibration.calibrate": Call(
        calibration.calibrate,
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
    "calibration.CalibrationReport.range_sigma_mm": Call(
        calibration.calibrate(SEEN, NOMINAL).range_sigma_mm,
        {"row": [100.0], "sigma_row": [0.3], "column": [639.5]},
        {"row": reals(), "sigma_row": reals(), "column": reals(optional=True)},
    ),
    "calibration.CalibrationFit.range_sigma_mm": Call(
        calibration.fit(SEEN, MODEL).range_sigma_mm,
        {"range_mm": [900.0], "column": [639.5]},
        {"range_mm": reals(), "column": reals(optional=True)},
    ),
    "calibration.fit": Call(
        calibration.fit,
        {"targets": SEEN, "design": MODEL, "free": ("k_prime_px",), "prior_sigma": None},
        {"free": FREE, "prior_sigma": PRIORS},
    ),
    "calibration.write_targets": Call(
        lambda path: calibration.write_targets(path, SEEN), {"path": "t.csv"}, {"path": path()}
    ),
    "calibration.read_targets": Call(
        reading(calibration.read_targets, "row,range_mm\n100,900\n"),
        {"path": "t.csv", "sigma_row_px": 0.3, "sigma_range_mm": 1.0},
        {"path": path(), **SIGMAS},
    ),
    "calibration.read_distances": Call(
        reading(calibration.read_distances, "range_mm\n900\n"),
        {"path": "t.csv", "sigma_range_mm": 1.0},
        {"path": path(), "sigma_range_mm": number(-1.0)},
    ),
}
