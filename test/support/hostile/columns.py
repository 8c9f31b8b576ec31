"""From columns of events to placed points."""

from __future__ import annotations

from typing import Any

import numpy as np
from line_events import blank_profiles

from eschorty_ros.core.line import centroid, reflectance
from eschorty_ros.core.reconstruction import paper_method as reference
from eschorty_ros.core.reconstruction import profiles, settings
from hostile.kinds import (
    HUGE,
    Call,
    Kind,
    integers,
    number,
    octets,
    text,
    vector,
    whole,
)
from hostile.subjects import (
    COLUMNS,
    LASER,
    MODEL,
    POINTS,
    ROWS,
    TIMES,
    N,
)
from hostile.surface import parameters


def blank_settings() -> dict[str, Any]:
    blank = settings.Settings()
    return {name: getattr(blank, name) for name in sorted(parameters(settings.Settings))}


def settings_kind(name: str, value: Any) -> Kind:
    if isinstance(value, str):
        return text()
    if name == "stage_speed_mm_s":
        return number(-10_000.1, 10_000.1)
    return whole(-1) if isinstance(value, int) else number(-1e-9)


CALLS: dict[str, Call] = {
    "centroid.check_method": Call(
        centroid.check_method,
        {"method": "mode_mean", "returns": "all"},
        {"method": text(), "returns": text()},
        {"method": "centroid"},
    ),
    "centroid.estimate": Call(
        centroid.estimate,
        {
            "rows": ROWS,
            "offsets": [0, 1, N],
            "method": "mode_mean",
            "returns": "last",
            "line_width_px": 20.0,
            "height": 720,
            "events_min": 1,
            "sigma_factor": 0.24,
            "sigma_floor_px": 0.2,
            "sigma_common_px": 0.1,
        },
        {
            "rows": integers(-1, 720, 65535, 2**40, size=N),
            "offsets": integers(-1, 5, 2**40, size=2),
            "method": text(),
            "returns": text(),
            "line_width_px": number(0.0, 721.0),
            "height": whole(0, 5000),
            "events_min": whole(0),
            "sigma_factor": number(-1.0),
            "sigma_floor_px": number(-1.0),
            "sigma_common_px": number(-1.0),
        },
        {"method": "centroid"},
    ),
    "profiles.LineRows.empty": Call(profiles.LineRows.empty, {}),
    "profiles.LineRows.concatenate": Call(
        profiles.Profiles.concatenate, {"parts": [blank_profiles(3)]}
    ),
    "profiles.Profiles.from_rows": Call(
        profiles.Profiles.from_rows,
        {"rows": profiles.LineRows.empty(), "model": MODEL},
        {"rows": Kind([])},
    ),
    "profiles.LineRows.select": Call(
        blank_profiles(N).select,
        {"mask": [0, 1]},
        {"mask": Kind(["abc", [0.5], [float("nan")], [N], [-N - 1], [True], [HUGE]])},
    ),
    "profiles.place_link": Call(
        profiles.place_link,
        {"profiles": blank_profiles(N), "model": MODEL, "origin_us": 0},
        {"origin_us": whole(2**63)},
    ),
    "profiles.place": Call(
        profiles.place,
        {
            "profiles": blank_profiles(N),
            "model": MODEL,
            "stage_position_mm": np.zeros(N),
            "stage_direction": (0.0, 1.0, 0.0),
            "origin_us": 0,
        },
        {
            "stage_position_mm": Kind(["abc", None, np.zeros(N + 1), np.zeros((2, 2))], [np.nan]),
            "stage_direction": vector(0.0, 1.0, size=3),
            "origin_us": whole(2**63),
        },
    ),
    "profiles.add_stage": Call(
        profiles.add_stage,
        {"points": POINTS.copy(), "position_mm": np.zeros(N), "stage_direction": (0.0, 1.0, 0.0)},
        {
            "points": Kind([]),
            "position_mm": Kind(["abc", None]),
            "stage_direction": vector(0.0, 1.0, size=3),
        },
    ),
    "profiles.stage_offset_m": Call(
        profiles.stage_offset_m,
        {"position_mm": np.zeros(N), "stage_direction": (0.0, 1.0, 0.0)},
        {"position_mm": Kind(["abc", None]), "stage_direction": vector(0.0, 1.0, size=3)},
    ),
    "reference.decode_all": Call(reference.decode_all, {"data": b"\x00\x80"}, {"data": octets()}),
    "reference.reconstruct": Call(
        reference.reconstruct,
        {
            "t_us": TIMES,
            "column": COLUMNS,
            "row": ROWS,
            "model": MODEL,
            "modulation": LASER,
            "events_min": 1,
        },
        {
            "t_us": integers(2**63, size=N),
            "column": integers(-1, 1280, size=N),
            "row": integers(-1, 720, size=N),
            "events_min": whole(0),
        },
    ),
    "reflectance.events_per_row": Call(
        reflectance.events_per_row,
        {"width_px": np.ones(N), "events": np.ones(N, np.uint32)},
        {"width_px": vector(-1.0, size=N), "events": integers(-1, size=N)},
    ),
    "reflectance.relative_reflectance": Call(
        reflectance.relative_reflectance,
        {
            "edge_us": np.zeros(N, np.int64),
            "width_px": np.ones(N),
            "events": np.ones(N, np.uint32),
            "footprint_sigma_px": 4.0,
            "white_width_px": 0.0,
        },
        {
            "edge_us": integers(2**63, size=N),
            "width_px": vector(-1.0, size=N),
            "events": integers(-1, size=N),
            "footprint_sigma_px": number(0.0),
            "white_width_px": number(-1.0),
        },
    ),
    "settings.Settings": Call(
        settings.Settings,
        blank_settings(),
        {name: settings_kind(name, value) for name, value in blank_settings().items()},
    ),
}
