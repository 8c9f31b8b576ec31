"""From the events of one period to one row per column with its sigma."""

from eschorty_ros.core.line.centroid import (
    FWHM_PER_SIGMA,
    HALF_WIDTH_PER_FWHM,
    METHODS,
    RETURNS,
    WHOLE_COLUMN_METHODS,
    Centroids,
    check_method,
    estimate,
    half_width_fixed,
)
from eschorty_ros.core.line.reflectance import ROOT_12, events_per_row, relative_reflectance
from eschorty_ros.core.line.row_sigma import (
    CLIPPED,
    METHOD_NOISE,
    OWN_PER_WIDTH2,
    SIGMA_COMMON_PX,
    SIGMA_FACTOR,
    SIGMA_FLOOR_PX,
    noise_of,
)
from eschorty_ros.core.line.smoothing import smooth

__all__ = [
    "CLIPPED",
    "FWHM_PER_SIGMA",
    "HALF_WIDTH_PER_FWHM",
    "METHODS",
    "METHOD_NOISE",
    "OWN_PER_WIDTH2",
    "RETURNS",
    "ROOT_12",
    "SIGMA_COMMON_PX",
    "SIGMA_FACTOR",
    "SIGMA_FLOOR_PX",
    "WHOLE_COLUMN_METHODS",
    "Centroids",
    "check_method",
    "estimate",
    "events_per_row",
    "half_width_fixed",
    "noise_of",
    "relative_reflectance",
    "smooth",
]
