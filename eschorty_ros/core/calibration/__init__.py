"""From targets and posts to an optical build with its covariance."""

from eschorty_ros.core.calibration.aggregate_frame import AggregateFrame
from eschorty_ros.core.calibration.calibrate import METHODS, CalibrationReport, Method, calibrate
from eschorty_ros.core.calibration.fit import (
    COLUMN_TERMS,
    K_PRIOR_SHARE,
    PARAMETERS,
    PRIOR_SIGMA,
    WIDTH_BIAS,
    CalibrationFit,
    fit,
    fit_targets,
)
from eschorty_ros.core.calibration.identity import refuse_other_instrument
from eschorty_ros.core.calibration.posts import (
    KnownTarget,
    Post,
    find_posts,
    match_posts,
    moving_target,
)
from eschorty_ros.core.calibration.recorded_targets import recorded_moving_target, recorded_posts
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
    "fit_targets",
    "match_posts",
    "moving_target",
    "read_distances",
    "read_targets",
    "recorded_moving_target",
    "recorded_posts",
    "refuse_other_instrument",
    "write_targets",
]
