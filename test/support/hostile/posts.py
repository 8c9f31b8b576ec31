"""From captured events to targets of a calibration."""

from __future__ import annotations

from typing import Any

import numpy as np
from line_events import blank_profiles

from eschorty_ros.core import calibration
from eschorty_ros.core import evt3
from hostile.kinds import Call, Kind, exactly, number, number_or_nan, vector, whole
from hostile.subjects import COLUMNS, MODEL, ROWS, N, method

WIDE = 20
POST = calibration.Post(100.0, 300.0, 0.2, 30.0, 0.5, 500)
KNOWN = calibration.KnownTarget(900.0)


def a_frame() -> calibration.AggregateFrame:
    return calibration.AggregateFrame(64, 48)


def add_to_frame(**pixels: Any) -> None:
    blank = np.empty(0, np.int64), np.empty(0, np.uint8)
    none = evt3.Triggers(blank[0], blank[1], blank[1])
    a_frame().add(evt3.Events(t=blank[0], p=blank[1], triggers=none, **pixels))


CALLS: dict[str, Call] = {
    "calibration.AggregateFrame": Call(
        calibration.AggregateFrame,
        {"columns": 64, "rows": 48},
        {"columns": whole(0), "rows": whole(0)},
    ),
    "calibration.AggregateFrame.add": Call(
        add_to_frame,
        {"x": COLUMNS, "y": ROWS},
        {"x": exactly("u2", N, alone=True), "y": exactly("u2", N)},
    ),
    "calibration.AggregateFrame.image": Call(method(a_frame, "image"), {}),
    "calibration.moving_target": Call(
        calibration.moving_target,
        {
            "profiles": blank_profiles(WIDE, column=np.arange(WIDE, dtype=np.uint16)),
            "stage_mm": np.zeros(WIDE),
            "range_at_zero_mm": 900.0,
            "range_per_stage": 1.0,
            "blocks": 1,
        },
        {
            "stage_mm": vector(finite=False, size=WIDE),
            "range_at_zero_mm": number(0.0),
            "range_per_stage": number(0.0),
            "blocks": whole(0, 65),
        },
    ),
    "calibration.find_posts": Call(
        calibration.find_posts,
        {"frame": a_frame(), "line_width_px": 20.0},
        {"line_width_px": number(0.0, 49.0)},
    ),
    "calibration.match_posts": Call(
        calibration.match_posts, {"posts": [POST], "known": [KNOWN], "nominal": MODEL}
    ),
    "calibration.KnownTarget": Call(
        calibration.KnownTarget,
        {
            "range_mm": 900.0,
            "sigma_range_mm": 0.0,
            "size_mm": 25.4,
            "column": 3.0,
            "row": 3.0,
            "label": "a",
        },
        {
            "range_mm": number(0.0),
            "sigma_range_mm": number(-1.0),
            "size_mm": number_or_nan(0.0, -1.0),
            "column": number_or_nan(),
            "row": number_or_nan(),
            "label": Kind([3, None, float("nan")]),
        },
    ),
}
