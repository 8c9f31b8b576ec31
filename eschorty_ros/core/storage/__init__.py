"""Recordings and clouds; Prophesee RAW files in ``raw_file``, which brings the decoder with it."""

from eschorty_ros.core.storage.cloud import (
    POINT_DTYPE,
    REFLECTANCE_DTYPE,
    Points,
    join_points,
    read_cloud,
    write_cloud,
)
from eschorty_ros.core.storage.recording import (
    CALIBRATION_FILE,
    EVENTS_FILE,
    LASER_FILE,
    STAGE_FILE,
    TRUTH_DTYPE,
    TRUTH_FILE,
    Recording,
    load_recording,
    read_laser_yaml,
    read_stage_csv,
    read_truth_csv,
    write_laser_yaml,
    write_stage_csv,
    write_truth_csv,
)

__all__ = [
    "CALIBRATION_FILE",
    "EVENTS_FILE",
    "LASER_FILE",
    "POINT_DTYPE",
    "REFLECTANCE_DTYPE",
    "STAGE_FILE",
    "TRUTH_DTYPE",
    "TRUTH_FILE",
    "Points",
    "Recording",
    "join_points",
    "load_recording",
    "read_cloud",
    "read_laser_yaml",
    "read_stage_csv",
    "read_truth_csv",
    "write_cloud",
    "write_laser_yaml",
    "write_stage_csv",
    "write_truth_csv",
]
