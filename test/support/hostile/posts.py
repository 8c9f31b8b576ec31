"""From captured events to targets of a calibration."""

from __future__ import annotations

from typing import Any

import numpy as np
from line_events import blank_profiles

from eschorty_ros.core.calibration import (
    aggregate_frame,
    moving_target,
    post_finder,
    post_matching,
    posts,
)
from eschorty_ros.core.evt3 import decoder as evt3
from hostile.kinds import Call, Kind, exactly, number, number_or_nan, vector, whole
from hostile.subjects import COLUMNS, MODEL, ROWS, N, method

WIDE = 20
POST = post_finder.Post(100.0, 300.0, 0.2, 30.0, 0.5, 500)
KNOWN = posts.KnownTarget(900.0)


def a_frame() -> aggregate_frame.AggregateFrame:
    return aggregate_frame.AggregateFrame(64, 48)


def add_to_frame(**pixels: Any) -> None:
    blank = np.empty(0, np.int64), np.empty(0, np.uint8)
    none = evt3.Triggers(blank[0], blank[1], blank[1])
    a_frame().add(evt3.Events(t=blank[0], p=blank[1], triggers=none, **pixels))


CALLS: dict[str, Call] = {
    "aggregate_frame.AggregateFrame": Call(
        aggregate_frame.AggregateFrame,
        {"columns": 64, "rows": 48},
        {"columns": whole(0), "rows": whole(0)},
    ),
    "aggregate_frame.AggregateFrame.add": Call(
        add_to_frame,
        {"x": COLUMNS, "y": ROWS},
        {"x": exactly("u2", N, alone=True), "y": exactly("u2", N)},
    ),
    "aggregate_frame.AggregateFrame.image": Call(method(a_frame, "image"), {}),
    "moving_target.moving_target": Call(
        moving_target.moving_target,
        {
            "profiles": blank_profiles(WIDE, column=np.arange(WIDE, dtype=np.uint16)),
            "stage_mm": np.zeros(WIDE),
            "range_at_zero_mm": 900.0,
            "range_per_stage": 1.0,
            "sigma_stage_mm": 0.01,
            "columns": None,
            "blocks": 1,
        },
        {
            "stage_mm": vector(finite=False, size=WIDE),
            "range_at_zero_mm": number(0.0),
            "range_per_stage": number(0.0),
            "sigma_stage_mm": number(0.0),
            "columns": Kind([3, "abc", (1,), (5, 1), (0.5, 9), ("a", "b"), (float("nan"), 3)]),
            "blocks": whole(0, 65),
        },
    ),
    "post_finder.find_posts": Call(
        post_finder.find_posts,
        {"frame": a_frame(), "line_width_px": 20.0, "columns_min": 8},
        {"line_width_px": number(0.0, 49.0), "columns_min": whole(0)},
    ),
    "post_matching.match_posts": Call(
        post_matching.match_posts, {"posts": [POST], "known": [KNOWN], "nominal": MODEL}
    ),
    "posts.KnownTarget": Call(
        posts.KnownTarget,
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
