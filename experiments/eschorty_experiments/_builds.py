"""The four builds of Table 1 as designs."""

from __future__ import annotations

import math

from eschorty_ros.core.optics import BUILDS, Design, design, load_calibration

BEAM_MRAD = 1.0
"""Divergence of the paper's laser."""


def builds() -> dict[str, Design]:
    """Make the builds by name, their sensor tilts from the printed ``k'`` (Eq. 1)."""
    made = {}
    for name in BUILDS:
        build = load_calibration(name)
        sine = build.focal_length_mm / (build.pixel_um * 1e-3 * -build.k_prime_px)
        made[name] = design(
            focal_length_mm=build.focal_length_mm,
            f_number=build.f_number,
            theta_deg=build.theta_deg,
            theta_prime_deg=-math.degrees(math.asin(sine)),
            b_prime_px=build.b_prime_px,
            b_mm=build.b_mm,
        )
    return made


def beam_rows(build: Design) -> float:
    """Return the rows under the beam's divergence, at every range ``k w / (p cos theta')``."""
    pixel_mm = build.model.pixel_um * 1e-3
    tilt = math.cos(math.radians(build.theta_prime_deg))
    return build.model.k_mm * BEAM_MRAD * 1e-3 / (pixel_mm * tilt)
