"""An optical build and what follows from it: ranges, sampling, depth of field, field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array, reals
from eschorty_ros.core.optics.range_model import RangeModel, depth_of_field_mm


def _cot(angle_deg: float) -> float:
    return 1.0 / math.tan(math.radians(angle_deg))


@dataclass(frozen=True, slots=True)
class DesignTable:
    """What a build does at some ranges; arrays of one shape, float64, NaN out of reach.

    Attributes
    ----------
    range_mm : ndarray
        Range from the mechanical datum.
    row : ndarray
        Where it appears, px; may lie off the sensor, see ``in_view``.
    in_view : ndarray of bool
        Whether the row is on the sensor.
    magnification : ndarray
        Image size over object size.
    range_per_row_mm : ndarray
        Range step of one row (Eq. 4).
    depth_of_field_mm : ndarray
        In focus within plus and minus this (Eq. 3).
    lateral_pitch_mm : ndarray
        Distance of neighbouring columns along the laser line.
    swath_mm : ndarray
        Length of laser line that all columns see.
    """

    range_mm: Array
    row: Array
    in_view: np.typing.NDArray[np.bool_]
    magnification: Array
    range_per_row_mm: Array
    depth_of_field_mm: Array
    lateral_pitch_mm: Array
    swath_mm: Array


@dataclass(frozen=True, slots=True)
class Design:
    """One optical build with everything that follows from it.

    Made by the functions of ``design``. Angles in degrees; ``theta_prime_deg``
    carries the sign it was given, which tells the side, and no formula uses it.
    """

    focal_length_mm: float
    f_number: float
    theta_deg: float
    theta_prime_deg: float
    model: RangeModel

    @property
    def baseline_mm(self) -> float:
        """Lens centre to Scheimpflug line, ``f (cot theta + cot|theta'|)``, mm."""
        return self.focal_length_mm * (_cot(self.theta_deg) + _cot(abs(self.theta_prime_deg)))

    @property
    def range_limits_mm(self) -> tuple[float, float]:
        """Nearest and farthest range on the sensor, rows 0 and ``rows - 1``, mm."""
        return self.model.range_limits_mm

    @property
    def field_deg(self) -> float:
        """Full scan angle of all columns, seen from the front focal line, degrees."""
        return 2.0 * math.degrees(math.atan(0.5 * self.model.columns * self.column_pitch_rad))

    @property
    def column_pitch_rad(self) -> float:
        """Scan angle of one column, ``p / k``, radians."""
        return self.model.pixel_um * 1e-3 / self.model.k_mm

    @property
    def depth_of_field_rows(self) -> float:
        """Half depth of field over range step, px: ``N p cos(theta') |k'| / (k sin theta)``.

        The same at every range.
        """
        return (
            self.f_number
            * self.model.pixel_um
            * 1e-3
            * math.cos(math.radians(self.theta_prime_deg))
            * -self.model.k_prime_px
            / (self.model.k_mm * math.sin(math.radians(self.theta_deg)))
        )

    @property
    def axis_range_mm(self) -> float:
        """Range at which the light sheet crosses the optical axis, mm; infinite when parallel."""
        theta = math.radians(self.theta_deg)
        if self.theta_deg == 90.0:
            return math.inf
        depth = (self.baseline_mm * math.tan(theta) - self.focal_length_mm) / math.sin(theta)
        return depth - self.model.b_mm

    @property
    def axis_row(self) -> float:
        """Row that looks along the optical axis, px; usually just off the sensor."""
        return float(self.model.row(self.axis_range_mm))

    def at(self, range_mm: ArrayLike) -> DesignTable:
        """Tabulate the build at ranges (mm, any shape)."""
        ranges = reals("range_mm", range_mm)
        row = self.model.row(ranges)
        magnification = self.model.magnification(row)
        with np.errstate(divide="ignore"):
            pitch_mm = self.model.pixel_um * 1e-3 / magnification
        return DesignTable(
            range_mm=ranges,
            row=row,
            in_view=(row >= 0.0) & (row <= self.model.rows - 1),
            magnification=magnification,
            range_per_row_mm=self.model.range_per_row_mm(ranges),
            depth_of_field_mm=depth_of_field_mm(
                magnification,
                self.f_number,
                self.theta_deg,
                self.theta_prime_deg,
                self.model.pixel_um,
            ),
            lateral_pitch_mm=pitch_mm,
            swath_mm=pitch_mm * self.model.columns,
        )
