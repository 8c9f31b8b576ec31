"""Range equation, design, targets and fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from eschorty_ros.core.calibration import targets
from eschorty_ros.core.optics import design
from eschorty_ros.core.optics import range_model as optics
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


def on_model(name: str, optional: str = "", **arguments: Any) -> Call:
    kinds = {argument: reals(optional=argument == optional) for argument in arguments}
    return Call(getattr(MODEL, name), arguments, kinds)


LENS = {"focal_length_mm": 24.0, "f_number": 2.0, "theta_deg": 85.87, "pixel_um": 4.86, "b_mm": 0.0}

LENS_KINDS = {
    "focal_length_mm": number(0.0), "f_number": number(0.0), "theta_deg": number(0.0, 91.0),
    "pixel_um": number(0.0), "b_mm": number(), "columns": whole(0), "rows": whole(0),
}  # fmt: skip

SIZES = {"columns": 1280, "rows": 720}

TARGET = dict.fromkeys(sorted(parameters(targets.Targets) - {"labels"}), 100.0)


CALLS: dict[str, Call] = {
    "optical_build.Design.at": Call(
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
            "b_prime_1_px": 0.0,
            "b_prime_2_px": 0.0,
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
            "b_prime_1_px": number(),
            "b_prime_2_px": number(),
        },
    ),
    "optics.RangeModel.range_mm": on_model("range_mm", "column", row=[3.0], column=[639.5]),
    "optics.RangeModel.row": on_model("row", "column", range_mm=[1300.0], column=[639.5]),
    "optics.RangeModel.magnification": on_model("magnification", row=[3.0]),
    "optics.RangeModel.range_per_row_mm": on_model("range_per_row_mm", range_mm=[1300.0]),
    "optics.RangeModel.range_sigma_mm": on_model(
        "range_sigma_mm", "column", row=[3.0], sigma_row=[0.3], column=[639.5]
    ),
    "optics.RangeModel.normalised_column": on_model("normalised_column", column=[3.0]),
    "optics.RangeModel.row_offset_px": on_model("row_offset_px", "column", column=[3.0]),
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
