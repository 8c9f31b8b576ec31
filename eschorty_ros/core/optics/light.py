"""Light of a build: photons that return from a column of the line, and an estimate of the class.

The class is estimated from the limits of IEC 60825-1:2014 (edition 3.0, tables 3, 5, 6, 8) for a
small source and long viewing; it is no safety statement. The line is spread over its fan, of which
an eye of 7 mm at 100 mm receives a part.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from eschorty_ros.core.base.numbers import number, positive
from eschorty_ros.core.optics.design import Design

_PUPIL_MM, _EYE_AT_MM = 7.0, 100.0
_THERMAL_MW = 0.39
_JOULE_NM = 1.98644586e-16
"""Planck's constant times the speed of light, J nm."""
VISIBLE_NM, INFRARED_NM = (400.0, 700.0), (700.0, 1050.0)


class LaserClass(NamedTuple):
    """The estimated class of a line of light."""

    accessible_mw: float
    """Power through a pupil of 7 mm at 100 mm from the line's origin."""
    limits_mw: dict[str, float]
    """Accessible emission limit of each class."""
    name: str
    """Lowest class within its limit."""


def laser_class(power_mw: float, wavelength_nm: float, fan_deg: float) -> LaserClass:
    """Return the estimated class of a line of light at its peak power.

    - ``power_mw``: Peak power of the line, mW: modulation is not counted in its favour.
    - ``wavelength_nm``: 400 to 1050.
    - ``fan_deg``: Full angle of the fan, degrees.

    Raises ``ArgumentError`` for values out of range.

    Examples
    --------
    >>> found = laser_class(power_mw=40.0, wavelength_nm=450.0, fan_deg=14.7)
    >>> print(found.name, round(found.accessible_mw, 1))
    3B 10.9
    """
    positive("power_mw", power_mw)
    number("wavelength_nm", wavelength_nm, VISIBLE_NM[0], INFRARED_NM[1])
    fan = math.radians(number("fan_deg", fan_deg, 0.0, 179.0))
    length_mm = 2.0 * _EYE_AT_MM * math.tan(0.5 * fan)
    accessible = power_mw * min(_PUPIL_MM / length_mm, 1.0) if length_mm else power_mw
    if wavelength_nm <= VISIBLE_NM[1]:
        # Beyond 100 s: the lower one of the thermal limit and the photochemical one with C3.
        photochemical = 0.039 * 10.0 ** (0.02 * max(wavelength_nm - 450.0, 0.0))
        limits = {"1": min(_THERMAL_MW, photochemical), "2": 1.0, "3R": 5.0, "3B": 500.0}
    else:
        # C7 is 1 up to 1150 nm.
        c4 = 10.0 ** (0.002 * (wavelength_nm - 700.0))
        limits = {"1": _THERMAL_MW * c4, "3R": 2.0 * c4, "3B": 500.0}
    name = next((name for name, limit in limits.items() if accessible <= limit), "4")
    return LaserClass(accessible, limits, name)


def photons_per_column(
    build: Design, range_mm: float, power_mw: float, wavelength_nm: float, seconds: float
) -> float:
    """Return the photons that one column of the line sends through the lens.

    The line is spread evenly over the columns, the target is white, matt (Lambert) and faces the
    sensor; lens and filter lose nothing.

    - ``range_mm``: From the mechanical datum.
    - ``power_mw``, ``wavelength_nm``: Of the light.
    - ``seconds``: Time of light, such as half a modulation period.
    """
    positive("range_mm + b_mm", range_mm + build.model.b_mm)
    along_mm, beside_mm = build.model.pupil_mm
    lens_mm = math.hypot(range_mm - along_mm, beside_mm)
    energy_j = power_mw * 1e-3 * positive("seconds", seconds) / build.model.columns
    aperture_mm = build.focal_length_mm / build.f_number
    collected = (0.5 * aperture_mm / lens_mm) ** 2
    return energy_j * min(collected, 1.0) * positive("wavelength_nm", wavelength_nm) / _JOULE_NM
