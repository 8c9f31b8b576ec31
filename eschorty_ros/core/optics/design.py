"""Choosing an optical build: from lens and tilts to ranges, and from ranges to tilts.

A build is a lens (focal length, f-number), a light sheet tilted by ``theta`` against the lens
plane, a sensor tilted by ``theta'`` and the row offset ``b'``, which selects the part of the sensor
plane. All three planes meet in the Scheimpflug line, ``baseline_mm`` from the lens centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array, reals
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import integer, number, positive
from eschorty_ros.core.optics.calibration_file import Calibration
from eschorty_ros.core.optics.range_model import (
    COLUMNS,
    PIXEL_UM,
    PIXELS_MAX,
    POLE_MARGIN_PX,
    ROWS,
    RangeModel,
    depth_of_field_mm,
    object_scale_mm,
)


@dataclass(frozen=True, slots=True)
class DesignTable:
    """Properties of a build at some ranges; arrays of one shape, float64, NaN out of reach."""

    range_mm: Array
    """Range from the mechanical datum."""
    row: Array
    """Its row, px; may be off the sensor, see ``in_view``."""
    in_view: NDArray[np.bool_]
    """True where the row is on the sensor."""
    magnification: Array
    """Image size over object size."""
    range_per_row_mm: Array
    """Range step of one row (Eq. 4)."""
    depth_of_field_mm: Array
    """In focus within plus and minus this (Eq. 3)."""
    lateral_pitch_mm: Array
    """Distance of neighbouring columns along the laser line."""
    swath_mm: Array
    """Length of the laser line over all columns."""


@dataclass(frozen=True, slots=True)
class Design:
    """An optical build with everything that follows from it; made by :func:`design`.

    The sign of ``theta_prime_deg`` is the side to which the sensor is tilted; no formula uses it.
    """

    focal_length_mm: float
    f_number: float
    theta_deg: float
    theta_prime_deg: float
    model: RangeModel

    @property
    def baseline_mm(self) -> float:
        """Lens centre to Scheimpflug line, ``f (cot theta + cot|theta'|)``, mm."""
        sheet, sensor = math.radians(self.theta_deg), math.radians(abs(self.theta_prime_deg))
        return self.focal_length_mm * (1.0 / math.tan(sheet) + 1.0 / math.tan(sensor))

    @property
    def range_limits_mm(self) -> tuple[float, float]:
        """Nearest and farthest range on the sensor, rows 0 and ``rows - 1``, mm."""
        return self.model.range_limits_mm

    @property
    def field_deg(self) -> float:
        """Full scan angle of all columns, seen from the front focal line, degrees."""
        return 2.0 * math.degrees(math.atan(0.5 * self.model.columns * self.model.slope_per_column))

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

    def calibration(self, name: str) -> Calibration:
        """Return the build as a calibration of a bare name, which is not fitted to anything."""
        model = self.model
        return Calibration(
            name=name,
            focal_length_mm=self.focal_length_mm,
            f_number=self.f_number,
            pixel_um=model.pixel_um,
            theta_deg=self.theta_deg,
            theta_prime_deg=self.theta_prime_deg,
            k_prime_px=model.k_prime_px,
            b_mm=model.b_mm,
            b_prime_px=model.b_prime_px,
            columns=model.columns,
            rows=model.rows,
            principal_column=model.principal_column,
        )

    def at(self, range_mm: ArrayLike) -> DesignTable:
        """Return the build's properties at ranges (mm, any shape)."""
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


def design(
    *,
    focal_length_mm: float,
    f_number: float,
    theta_deg: float,
    theta_prime_deg: float | None = None,
    baseline_mm: float | None = None,
    b_prime_px: float | None = None,
    near_mm: float | None = None,
    b_mm: float = 0.0,
    pixel_um: float = PIXEL_UM,
    columns: int = COLUMNS,
    rows: int = ROWS,
) -> Design:
    """Return the build of a lens, two tilts and a row offset (Eq. 1).

    - ``focal_length_mm``, ``f_number``: The lens.
    - ``theta_deg``: Tilt of the light sheet, above 0 up to 90.
    - ``theta_prime_deg``, ``baseline_mm``: Exactly one: tilt of the sensor, or the distance from
      lens centre to Scheimpflug line that implies it.
    - ``b_prime_px``, ``near_mm``: Exactly one: the row offset, or the range at row 0.
    - ``b_mm``: Mechanical datum to front focal line.
    - ``pixel_um``, ``columns``, ``rows``: The sensor.

    Raises ``ArgumentError`` when a value is out of its range or a choice is not made exactly once.

    Examples
    --------
    The paper's third build:

    >>> build = design(
    ...     focal_length_mm=24.0, f_number=2.0, theta_deg=85.87,
    ...     theta_prime_deg=-7.62, b_prime_px=-1142.74,
    ... )
    >>> near_mm, far_mm = build.range_limits_mm
    >>> print(f"{near_mm:.0f} to {far_mm:.0f} mm, baseline {build.baseline_mm:.1f} mm")
    784 to 2115 mm, baseline 181.1 mm
    >>> print(f"{build.at(1320.0).range_per_row_mm:.2f} mm per row at 1.32 m")
    1.94 mm per row at 1.32 m
    """
    _check_lens(focal_length_mm, f_number, theta_deg, pixel_um)
    integer("columns", columns, 1, PIXELS_MAX)
    tilt_deg = _sensor_tilt_deg(focal_length_mm, theta_deg, theta_prime_deg, baseline_mm)
    k_mm = object_scale_mm(focal_length_mm, theta_deg)
    k_prime_px = -focal_length_mm / (pixel_um * 1e-3 * math.sin(math.radians(abs(tilt_deg))))
    if (b_prime_px is None) == (near_mm is None):
        raise ArgumentError(
            f"b_prime_px is {b_prime_px!r} and near_mm {near_mm!r}; give exactly one of them"
        )
    if b_prime_px is None:
        b_prime_px = k_mm * k_prime_px / _depth("near_mm", near_mm, b_mm)
        if b_prime_px > -POLE_MARGIN_PX:
            raise ArgumentError(
                f"near_mm is {near_mm!r}: row 0 would be within {POLE_MARGIN_PX:g} px of infinity; "
                f"choose less than {-k_mm * k_prime_px / POLE_MARGIN_PX - b_mm:.6g}"
            )
    model = RangeModel(
        k_mm=k_mm,
        k_prime_px=k_prime_px,
        b_mm=b_mm,
        b_prime_px=b_prime_px,
        pixel_um=pixel_um,
        columns=columns,
        rows=rows,
        principal_column=(columns - 1) / 2,
        theta_deg=theta_deg,
    )
    return Design(focal_length_mm, f_number, theta_deg, tilt_deg, model)


def design_for_ranges(
    *,
    near_mm: float,
    far_mm: float,
    focal_length_mm: float,
    f_number: float,
    theta_deg: float,
    b_mm: float = 0.0,
    pixel_um: float = PIXEL_UM,
    columns: int = COLUMNS,
    rows: int = ROWS,
) -> Design:
    """Return the build with ``near_mm`` at row 0 and ``far_mm`` at the last row (Eq. 2).

    The two ranges fix ``K`` and ``b'``; the lens fixes ``k``, so ``k'`` and the sensor tilt
    follow. Parameters as in :func:`design`.

    Raises ``ArgumentError`` when ``0 < near + b < far + b`` does not hold, no sensor tilt reaches
    both ranges, or the last row would be within 1 px of the pole.
    """
    _check_lens(focal_length_mm, f_number, theta_deg, pixel_um)
    integer("rows", rows, 2, PIXELS_MAX)
    near, far = _depth("near_mm", near_mm, b_mm), _depth("far_mm", far_mm, b_mm)
    if not near < far:
        raise ArgumentError(f"far_mm is {far_mm!r}; choose more than near_mm = {near_mm!r}")
    product_mm_px = -(rows - 1) * near * far / (far - near)
    k_prime_px = product_mm_px / object_scale_mm(focal_length_mm, theta_deg)
    sine = -focal_length_mm / (pixel_um * 1e-3 * k_prime_px)
    if not sine < 1.0:
        raise ArgumentError(
            f"near_mm = {near_mm!r} to far_mm = {far_mm!r} needs sin(theta') = {sine:.3g}; "
            "choose a longer near range or a shorter focal length"
        )
    build = design(
        focal_length_mm=focal_length_mm,
        f_number=f_number,
        theta_deg=theta_deg,
        theta_prime_deg=-math.degrees(math.asin(sine)),
        near_mm=near_mm,
        b_mm=b_mm,
        pixel_um=pixel_um,
        columns=columns,
        rows=rows,
    )
    if build.range_limits_mm[1] == math.inf:
        raise ArgumentError(
            f"far_mm is {far_mm!r}: the last row would be within {POLE_MARGIN_PX:g} px of "
            f"infinity; choose less than {rows * near - b_mm:.6g}"
        )
    return build


def _check_lens(focal_length_mm: float, f_number: float, theta_deg: float, pixel_um: float) -> None:
    named = {"focal_length_mm": focal_length_mm, "f_number": f_number, "pixel_um": pixel_um}
    for name, value in named.items():
        positive(name, value)
    if not 0.0 < number("theta_deg", theta_deg) <= 90.0:
        raise ArgumentError(f"theta_deg is {theta_deg!r}; choose above 0 up to 90 degrees")


def _sensor_tilt_deg(
    focal_length_mm: float, theta_deg: float, tilt_deg: float | None, baseline_mm: float | None
) -> float:
    if (tilt_deg is None) == (baseline_mm is None):
        raise ArgumentError(
            f"theta_prime_deg is {tilt_deg!r} and baseline_mm {baseline_mm!r}; "
            "give exactly one of them"
        )
    if tilt_deg is not None:
        if not 1e-6 < abs(number("theta_prime_deg", tilt_deg)) < 90.0:
            raise ArgumentError(
                f"theta_prime_deg is {tilt_deg!r}; choose 0 to 90 degrees of either sign, "
                "without the ends"
            )
        return tilt_deg
    sheet = 1.0 / math.tan(math.radians(theta_deg))
    cotangent = number("baseline_mm", baseline_mm) / focal_length_mm - sheet
    if not 0.0 < cotangent < math.inf:
        raise ArgumentError(
            f"baseline_mm is {baseline_mm!r}; choose more than f cot(theta) = "
            f"{focal_length_mm * sheet:.3f} mm"
        )
    return -math.degrees(math.atan(1.0 / cotangent))


def _depth(name: str, range_mm: float | None, b_mm: float) -> float:
    depth = number(name, range_mm) + number("b_mm", b_mm)
    if not 1e-6 < depth < math.inf:
        beyond_mm = 0.0 - b_mm
        raise ArgumentError(
            f"{name} is {range_mm!r}; choose a range beyond -b_mm = {beyond_mm:g} mm"
        )
    return depth
