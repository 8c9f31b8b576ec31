"""From the events of one period to one row per column with its standard deviation."""

from eschorty_ros.core.line.estimators import (
    CENTROIDS,
    FULL_COLUMN_METHODS,
    FWHM_PER_SIGMA,
    METHODS,
    RETURNS,
    check_method,
)
from eschorty_ros.core.line.independent_columns import Centroids, estimate
from eschorty_ros.core.line.reflectance import ROOT_12, events_per_row, relative_reflectance
from eschorty_ros.core.line.sigma import SIGMA_FLOOR_PX
from eschorty_ros.core.line.window import HALF_WIDTH_PER_FWHM, TIME_LIMIT_US

__all__ = [
    "CENTROIDS",
    "FULL_COLUMN_METHODS",
    "FWHM_PER_SIGMA",
    "HALF_WIDTH_PER_FWHM",
    "METHODS",
    "RETURNS",
    "ROOT_12",
    "SIGMA_FLOOR_PX",
    "TIME_LIMIT_US",
    "Centroids",
    "check_method",
    "estimate",
    "events_per_row",
    "relative_reflectance",
]
