"""From targets and posts to an optical build with its covariance."""

from eschorty_ros.core.calibration.aggregate_frame import AggregateFrame
from eschorty_ros.core.calibration.calibrate import METHODS, CalibrationReport, Method, calibrate
from eschorty_ros.core.calibration.fit import K_PRIOR_SHARE, PRIOR_SIGMA, CalibrationFit, fit
from eschorty_ros.core.calibration.moving_target import moving_target
from eschorty_ros.core.calibration.post_finder import Post, find_posts
from eschorty_ros.core.calibration.post_matching import KnownTarget, match_posts
from eschorty_ros.core.calibration.recorded_targets import recorded_moving_target, recorded_posts
from eschorty_ros.core.calibration.residuals import COLUMN_TERMS, PARAMETERS, WIDTH_BIAS
from eschorty_ros.core.calibration.targets import SIGMA_ROW_PX, Targets
from eschorty_ros.core.calibration.targets_file import (
    DISTANCE_COLUMNS,
    TARGET_COLUMNS,
    read_distances,
    read_targets,
    write_targets,
)

__all__ = [
    "COLUMN_TERMS",
    "DISTANCE_COLUMNS",
    "K_PRIOR_SHARE",
    "METHODS",
    "PARAMETERS",
    "PRIOR_SIGMA",
    "SIGMA_ROW_PX",
    "TARGET_COLUMNS",
    "WIDTH_BIAS",
    "AggregateFrame",
    "CalibrationFit",
    "CalibrationReport",
    "KnownTarget",
    "Method",
    "Post",
    "Targets",
    "calibrate",
    "find_posts",
    "fit",
    "match_posts",
    "moving_target",
    "read_distances",
    "read_targets",
    "recorded_moving_target",
    "recorded_posts",
    "write_targets",
]
