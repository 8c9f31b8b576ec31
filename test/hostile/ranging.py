"""Range equation, design, targets and fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from eschorty_ros.core import (
    calibration_fit,
    design,
    optics,
    targets,
)
from hostile.kinds import (
    Call,
    Kind,
    number,
    reals,
    vector,
    whole,
)
from hostile.subjects import (
    MODEL,
)
from hostile.surface import parameters


def on_model(name: str, **arguments: Any) -> Call:
    return Call(getattr(MODEL, name), arguments, dict.fromkeys(arguments, reals()))


LENS = {"focal_length_mm": 24.0, "f_number": 2.0, "theta_deg": 85.87, "pixel_um": 4.86, "b_mm": 0.0}

LENS_KINDS = {
    "focal_length_mm": number(0.0), "f_number": number(0.0), "theta_deg": number(0.0, 91.0),
    "pixel_um": number(0.0), "b_mm": number(), "columns": whole(0), "rows": whole(0),
}  # fmt: skip

SIZES = {"columns": 1280, "rows": 720}

FIT = {"row": [100.0, 300.0, 500.0], "range_mm": [860.0, 1064.0, 1395.0], "design": MODEL}

TARGET = dict.fromkeys(parameters(targets.Targets) - {"labels"}, 100.0)


CALLS: dict[str, Call] = {
    "calibration_fit.CalibrationFit.range_sigma_mm": Call(
        calibration_fit.fit_targets(**FIT).range_sigma_mm,
        {"range_mm": [900.0, 1300.0]},
        {"range_mm": reals()},
    ),
    "calibration_fit.fit_targets": Call(
        calibration_fit.fit_targets,
        dict(
            FIT,
            free=("k_prime_px", "b_prime_px"),
            sigma_row_px=0.3,
            sigma_range_mm=0.0,
            prior_sigma=None,
        ),
        {
            "row": vector(-1.0, 720.0, size=3),
            "range_mm": vector(0.0, -5.0, size=3),
            "free": Kind([None, 3, "k", ["k_mm", "k_mm"], [], [3], [[]]]),
            "sigma_row_px": vector(0.0, -1.0, size=3),
            "sigma_range_mm": vector(-1.0, size=3),
            "prior_sigma": Kind(
                [{"k_mm": 1.0}, {"b_prime_px": 0.0}, {"b_prime_px": "a"}, 3, "k_mm"]
            ),
        },
    ),
    "design.Design.at": Call(
        design.design(theta_prime_deg=-7.6, b_prime_px=-1100.0, **LENS).at,
        {"range_mm": [900.0, 1300.0]},
        {"range_mm": reals()},
    ),
    "design.design": Call(
        design.design,
        dict(
            LENS, **SIZES, theta_prime_deg=-7.6, baseline_mm=None, b_prime_px=-1100.0, near_mm=None
        ),
        dict(
            LENS_KINDS,
            theta_prime_deg=number(0.0, 91.0),
            baseline_mm=Kind([3.0, "abc"]),
            b_prime_px=number(0.0),
            near_mm=Kind([3.0, "abc"]),
        ),
    ),
    "design.design_for_ranges": Call(
        design.design_for_ranges,
        dict(LENS, **SIZES, near_mm=800.0, far_mm=2100.0),
        dict(LENS_KINDS, near_mm=number(0.0, 2100.0), far_mm=number(800.0)),
    ),
    "optics.object_scale_mm": Call(
        optics.object_scale_mm,
        {"focal_mm": 24.0, "theta_deg": 85.0},
        {"focal_mm": number(0.0), "theta_deg": number(0.0, 180.0)},
    ),
    "optics.depth_of_field_mm": Call(
        optics.depth_of_field_mm,
        {
            "magnification": [0.02],
            "f_number": 2.0,
            "theta_deg": 85.0,
            "theta_prime_deg": -7.0,
            "pixel_um": 5.0,
        },
        {
            "magnification": reals(),
            "f_number": number(0.0),
            "theta_deg": number(0.0),
            "theta_prime_deg": number(-91.0, 91.0),
            "pixel_um": number(0.0),
        },
    ),
    "optics.RangeModel": Call(
        optics.RangeModel,
        {
            "k_mm": 24.0,
            "k_prime_px": -37000.0,
            "b_mm": 0.0,
            "b_prime_px": -1140.0,
            "pixel_um": 4.86,
            "columns": 1280,
            "rows": 720,
            "principal_column": 639.5,
            "theta_deg": 85.87,
        },
        {
            "k_mm": number(0.0),
            "k_prime_px": number(0.0),
            "b_mm": number(),
            "b_prime_px": number(-0.5),
            "pixel_um": number(0.0),
            "columns": whole(0),
            "rows": whole(0),
            "principal_column": number(),
            "theta_deg": number(0.0, 91.0),
        },
    ),
    "optics.RangeModel.range_mm": on_model("range_mm", row=[3.0]),
    "optics.RangeModel.row": on_model("row", range_mm=[1300.0]),
    "optics.RangeModel.magnification": on_model("magnification", row=[3.0]),
    "optics.RangeModel.range_per_row_mm": on_model("range_per_row_mm", range_mm=[1300.0]),
    "optics.RangeModel.range_sigma_mm": on_model("range_sigma_mm", row=[3.0], sigma_row=[0.3]),
    "optics.RangeModel.column_slope": on_model("column_slope", column=[3.0]),
    "optics.RangeModel.lateral_mm": on_model("lateral_mm", column=[3.0], range_mm=[1300.0]),
    "optics.RangeModel.rows_per_mm_off_sheet": on_model("rows_per_mm_off_sheet", range_mm=[1300.0]),
    "targets.Targets": Call(
        targets.Targets,
        dict(TARGET, labels=["a"]),
        dict(
            dict.fromkeys(TARGET, vector(-1.0, np.inf, finite=False)),
            row=vector(),
            column=vector(np.inf, finite=False),
            labels=Kind([[3], ["a", "b"], 3]),
        ),
    ),
    "targets.Targets.select": Call(
        targets.Targets(row=[1.0, 2.0], range_mm=[900.0, 901.0]).select,
        {"which": [1]},
        {"which": Kind(["abc", [0.5], [2], [-3], [True], None])},
    ),
    "targets.Targets.concatenate": Call(
        targets.Targets.concatenate, {"parts": [targets.Targets(row=1.0, range_mm=900.0)]}
    ),
}
