"""Rows to ranges and back (Eqs. 1 to 4), the design of a build and its file."""

from eschorty_ros.core.optics.calibration_file import (
    BUILDS,
    PARAMETERS,
    SHIPPED,
    Calibration,
    config_file,
    load_calibration,
    load_named_calibration,
    refuse_other_instrument,
    refuse_other_sensor,
    save_calibration,
    save_named_calibration,
)
from eschorty_ros.core.optics.design import Design, DesignTable, design, design_for_ranges
from eschorty_ros.core.optics.light import LaserClass, laser_class, photons_per_column
from eschorty_ros.core.optics.range_model import (
    COLUMNS,
    PIXELS_MAX,
    POLE_MARGIN_PX,
    RangeModel,
    depth_of_field_mm,
)

__all__ = [
    "BUILDS",
    "COLUMNS",
    "PARAMETERS",
    "PIXELS_MAX",
    "POLE_MARGIN_PX",
    "SHIPPED",
    "Calibration",
    "Design",
    "DesignTable",
    "LaserClass",
    "RangeModel",
    "config_file",
    "depth_of_field_mm",
    "design",
    "design_for_ranges",
    "laser_class",
    "load_calibration",
    "load_named_calibration",
    "photons_per_column",
    "refuse_other_instrument",
    "refuse_other_sensor",
    "save_calibration",
    "save_named_calibration",
]
