"""Files of calibrations, clouds and recordings."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from eschorty_ros.core.base import files, yaml_file
from eschorty_ros.core.base.errors import CalibrationError
from eschorty_ros.core.optics import calibration_file as calibration
from eschorty_ros.core.storage import cloud, recording
from hostile.kinds import (
    Call,
    Kind,
    integers,
    path,
    vector,
)
from hostile.subjects import (
    CALIBRATION,
    COLUMNS,
    LASER,
    PATH_ONLY,
    POINTS,
    TIMES,
    N,
)


def write_atomically(path: Any) -> None:
    with files.atomic_write(path) as stream:
        stream.write(b"x")


CALLS: dict[str, Call] = {
    "calibration.config_file": Call(
        calibration.config_file, {"name": "config_3.yaml"}, {"name": path()}
    ),
    "calibration.load_calibration": Call(
        calibration.load_calibration,
        {"name_or_path": "config_3"},
        {"name_or_path": path()},
    ),
    "calibration.save_calibration": Call(
        partial(calibration.save_calibration, CALIBRATION), {"path": "c.yaml"}, PATH_ONLY
    ),
    "cloud.write_cloud": Call(
        cloud.write_cloud,
        {"path": "c.pcd", "points": POINTS},
        {"path": path(), "points": Kind([None, 3, "abc", np.zeros(3), POINTS.reshape(2, 2)])},
    ),
    "cloud.read_cloud": Call(
        lambda path: (cloud.write_cloud("c.pcd", POINTS), cloud.read_cloud(path)),
        {"path": "c.pcd"},
        PATH_ONLY,
    ),
    "cloud.join_points": Call(
        cloud.join_points,
        {"parts": [POINTS, POINTS]},
        {"parts": Kind([[], None, 3, [3], [np.zeros(3)], "abc", [POINTS, None]])},
    ),
    "files.atomic_write": Call(write_atomically, {"path": "a.txt"}, PATH_ONLY),
    "files.check_writable": Call(files.check_writable, {"path": "a.txt"}, PATH_ONLY),
    "recording.load_recording": Call(recording.load_recording, {}, PATH_ONLY),
    "recording.read_laser_yaml": Call(
        lambda path: (
            recording.write_laser_yaml("laser.yaml", LASER),
            recording.read_laser_yaml(path),
        ),
        {"path": "laser.yaml"},
        PATH_ONLY,
    ),
    "recording.write_laser_yaml": Call(
        partial(recording.write_laser_yaml, modulation=LASER), {"path": "laser.yaml"}, PATH_ONLY
    ),
    "recording.write_stage_csv": Call(
        recording.write_stage_csv,
        {"path": "stage.csv", "t_us": TIMES, "position_mm": np.zeros(N)},
        {"path": path(), "t_us": integers(2**63, size=N), "position_mm": vector(2e9, size=N)},
    ),
    "recording.write_truth_csv": Call(
        recording.write_truth_csv,
        {"path": "truth.csv", "t_us": TIMES, "column": COLUMNS, "range_mm": np.zeros(N)},
        {
            "path": path(),
            "t_us": integers(2**63, size=N),
            "column": integers(-1, 65536, size=N),
            "range_mm": vector(2e9, size=N),
        },
    ),
    "yaml_file.read_yaml": Call(
        partial(yaml_file.read_yaml, error=CalibrationError), {"path": "a.yaml"}, PATH_ONLY
    ),
    "yaml_file.validate": Call(
        partial(yaml_file.validate, calibration.Calibration, error=CalibrationError),
        {"data": {}, "where": "a.yaml"},
        {"data": Kind([None, 3, "abc", [], {}, {3: 4}, {"name": 5}]), "where": Kind([])},
    ),
}
