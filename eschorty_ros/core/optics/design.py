"""Choosing an optical build: from lens and tilts to ranges, and from ranges to tilts.

A build is a lens (focal length, f-number), a light sheet tilted by ``theta`` against the lens
plane, a sensor tilted by ``theta'`` and the row offset ``b'`` that says which part of the sensor
plane is used. All three planes meet in the Scheimpflug line, ``baseline_mm`` from the lens centre.
"""

from __future__ import annotations

import math

from eschorty_ros.core.base.arrays import integer, number, positive
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics.optical_build import Design
from eschorty_ros.core.optics.range_model import (
    COLUMNS,
    PIXEL_UM,
    PIXELS_MAX,
    ROWS,
    RangeModel,
    object_scale_mm,
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
    """Build from lens, tilts and row offset (Eq. 1).

    Parameters
    ----------
    focal_length_mm, f_number : float
        The lens.
    theta_deg : float
        Tilt of the light sheet, above 0 up to 90.
    theta_prime_deg, baseline_mm : float
        Exactly one: tilt of the sensor, or the distance from lens centre to Scheimpflug line
        that implies it.
    b_prime_px, near_mm : float
        Exactly one: the row offset, or the range that row 0 shall see.
    b_mm : float
        Mechanical datum to front focal line.
    pixel_um, columns, rows
        The sensor.

    Raises
    ------
    ArgumentError
        When a value is out of its range or a choice is not made exactly once.
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
    """Build that sees ``near_mm`` at row 0 and ``far_mm`` at the last row (Eq. 2 at two rows).

    The two ranges fix ``K`` and ``b'``; the lens fixes ``k``, so ``k'`` and the sensor tilt
    follow. Parameters as in :func:`design`.

    Raises
    ------
    ArgumentError
        When ``0 < near + b < far + b`` does not hold or no sensor tilt reaches both ranges.
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
    return design(
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
    assert baseline_mm is not None
    sheet = 1.0 / math.tan(math.radians(theta_deg))
    cotangent = number("baseline_mm", baseline_mm) / focal_length_mm - sheet
    if not 0.0 < cotangent < math.inf:
        raise ArgumentError(
            f"baseline_mm is {baseline_mm!r}; choose more than f cot(theta) = "
            f"{focal_length_mm * sheet:.3f} mm"
        )
    return -math.degrees(math.atan(1.0 / cotangent))


def _depth(name: str, range_mm: float | None, b_mm: float) -> float:
    if not 1e-6 < number(name, range_mm) + number("b_mm", b_mm) < math.inf:
        raise ArgumentError(f"{name} is {range_mm!r}; choose a range beyond -b_mm = {-b_mm:g} mm")
    return float(range_mm or 0.0) + b_mm
