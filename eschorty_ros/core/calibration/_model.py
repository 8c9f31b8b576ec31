"""What targets should look like, its derivatives, and residuals made independent.

Every target has three channels: its row (Eq. 2), the columns it covers and the columns between two
marks (the magnification). What a target does not tell is masked. A target's range error moves all
its channels together, so they are whitened together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import RangeModel

Values = dict[str, float]

PARAMETERS = ("k_mm", "k_prime_px", "b_mm", "b_prime_px")
COLUMN_TERMS = ("b_prime_1_px", "b_prime_2_px")
WIDTH_BIAS = "width_bias_px"
EVERY = (*PARAMETERS, *COLUMN_TERMS, WIDTH_BIAS)
CHANNELS = 3


def values_of(model: RangeModel) -> Values:
    """Return the parameters of a build as named numbers; no width bias."""
    return {name: float(getattr(model, name, 0.0)) for name in EVERY}


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Targets as a fit uses them; arrays of shape (n,) or (n, 3).

    Attributes
    ----------
    range_mm, column_u : ndarray, shape (n,)
        Known range; normalised column, 0 where unknown.
    seen, sigma : ndarray, shape (n, 3)
        Row, width and spacing, px, and their standard deviations; 0 and 1 where unknown.
    known : ndarray of bool, shape (n, 3)
        Channels that hold something.
    per_pixel : ndarray, shape (n, 3)
        Size and spacing over the pixel pitch; 0 for rows and where unknown.
    sigma_range_mm : ndarray, shape (n,)
    """

    range_mm: Array
    column_u: Array
    seen: Array
    sigma: Array
    known: NDArray[np.bool_]
    per_pixel: Array
    sigma_range_mm: Array

    @classmethod
    def of(cls, targets: Targets, design: RangeModel) -> Observed:
        row_only = np.ones(len(targets), dtype=bool)
        known = np.stack([row_only, targets.has_width, targets.has_spacing], axis=1)
        seen = np.stack([targets.row, targets.width_px, targets.spacing_px], axis=1)
        sigma = np.stack(
            [targets.sigma_row_px, targets.sigma_width_px, targets.sigma_spacing_px], axis=1
        )
        size_mm = np.stack([0.0 * targets.row, targets.size_mm, targets.spacing_mm], axis=1)
        return cls(
            targets.range_mm,
            np.nan_to_num(design.normalised_column(targets.column)),
            np.where(known, seen, 0.0),
            np.where(known, sigma, 1.0),
            known,
            np.where(known, size_mm, 0.0) / (design.pixel_um * 1e-3),
            targets.sigma_range_mm,
        )

    def __len__(self) -> int:
        return self.range_mm.size

    def select(self, which: NDArray[np.bool_]) -> Observed:
        return Observed(*(getattr(self, name)[which] for name in self.__slots__))

    def rows_only(self) -> Observed:
        """Return the targets without their sizes."""
        known = self.known.copy()
        known[:, 1:] = False
        return replace(
            self,
            known=known,
            seen=np.where(known, self.seen, 0.0),
            sigma=np.where(known, self.sigma, 1.0),
            per_pixel=np.where(known, self.per_pixel, 0.0),
        )

    def residual(self, p: Values) -> Array | None:
        """Return seen minus expected, px, shape (n, 3); ``None`` where the build is impossible."""
        depth = self.range_mm + p["b_mm"]
        if not depth.min() > 0.0:
            return None
        expected = self.per_pixel * (p["k_mm"] / depth)[:, None]
        offset = p["b_prime_px"] + self.column_u * (
            p["b_prime_1_px"] + self.column_u * p["b_prime_2_px"]
        )
        expected[:, 0] = p["k_mm"] * p["k_prime_px"] / depth - offset
        expected[:, 1] += p[WIDTH_BIAS]
        return np.where(self.known, self.seen - expected, 0.0)

    def derivative(self, p: Values, names: Sequence[str]) -> Array:
        """Return expected channels by the named parameters, shape (n, 3, p)."""
        depth = self.range_mm + p["b_mm"]
        made = np.zeros((len(self), CHANNELS, len(names)))
        for index, name in enumerate(names):
            if name == "k_mm":
                made[:, :, index] = self.per_pixel / depth[:, None]
            elif name == "b_mm":
                made[:, :, index] = -self.per_pixel * (p["k_mm"] / (depth * depth))[:, None]
            elif name == WIDTH_BIAS:
                made[:, 1, index] = self.known[:, 1]
            made[:, 0, index] = row_derivative(p, depth, self.column_u, name)
        return made

    def root_covariance(self, p: Values) -> Array:
        """Lower triangles, shape (n, 3, 3), whose squares are the covariances of the channels."""
        gradient = self.derivative(p, ["b_mm"])[:, :, 0] * self.sigma_range_mm[:, None]
        square = gradient[:, :, None] * gradient[:, None, :]
        diagonal = np.arange(CHANNELS)
        square[:, diagonal, diagonal] += self.sigma * self.sigma
        return np.asarray(np.linalg.cholesky(square))


def row_derivative(p: Mapping[str, float], depth_mm: Array, column_u: Array, name: str) -> Array:
    """Differentiate the row (Eq. 2) by a parameter; shape of ``depth_mm``."""
    if name == "k_mm":
        return p["k_prime_px"] / depth_mm
    if name == "k_prime_px":
        return p["k_mm"] / depth_mm
    if name == "b_mm":
        return -p["k_mm"] * p["k_prime_px"] / (depth_mm * depth_mm)
    powers = {"b_prime_px": 0, "b_prime_1_px": 1, "b_prime_2_px": 2}
    if name in powers:
        return np.asarray(-(column_u ** powers[name]) * np.ones_like(depth_mm))
    return np.zeros_like(depth_mm)
