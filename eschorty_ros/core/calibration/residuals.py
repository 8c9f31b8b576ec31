"""Residuals of targets against a build, in standard deviations, and their derivatives.

Every target has three channels: its row (Eq. 2), the columns it covers and the columns between two
marks (both from the magnification, Eq. 1). Channels that were not measured are masked. The error of
a target's range moves all its channels together, so they are whitened together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import POLE_MARGIN_PX, RangeModel

Values = dict[str, float]

PARAMETERS = ("k_mm", "k_prime_px", "b_mm", "b_prime_px")
COLUMN_TERMS = ("b_prime_1_px", "b_prime_2_px")
WIDTH_BIAS = "width_bias_px"
EVERY = (*PARAMETERS, *COLUMN_TERMS, WIDTH_BIAS)
LATERAL = {"k_mm", WIDTH_BIAS}
"""Parameters that widths and spacings determine."""
_CHANNELS = 3
_RANK_TOLERANCE = 1e-12


def values_of(model: RangeModel) -> Values:
    """Return the parameters of a build by name; a build has no width bias."""
    return {name: float(getattr(model, name, 0.0)) for name in EVERY}


def row_derivative(p: Mapping[str, float], depth_mm: Array, column_u: Array, name: str) -> Array:
    """Return the derivative of the row (Eq. 2) by a parameter; shape of ``depth_mm``."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Targets as a fit uses them; arrays of shape (n,) or (n, 3)."""

    range_mm: Array
    column_u: Array
    """Shape (n,). Known range; normalised column, 0 where unknown."""
    measured: Array
    sigma: Array
    """Shape (n, 3). Row, width and spacing, px, and their standard deviations; 0 and 1 where
    unknown."""
    known: NDArray[np.bool_]
    """Shape (n, 3). Channels that were measured and that the fit uses."""
    per_pixel: Array
    """Shape (n, 3). Size and spacing over the pixel pitch; 0 for rows and where unknown."""
    sigma_range_mm: Array
    sigma_shared_mm: Array
    """Shape (n,). Of each range alone, and of the error that all ranges share."""

    @classmethod
    def of(cls, targets: Targets, design: RangeModel, names: Sequence[str]) -> Observed:
        """Return the targets with the channels that these free parameters depend on."""
        lateral = bool(LATERAL & set(names))
        row_only = np.ones(len(targets), dtype=bool)
        known = np.stack(
            [row_only, lateral & targets.has_width, lateral & targets.has_spacing], axis=1
        )
        measured = np.stack([targets.row, targets.width_px, targets.spacing_px], axis=1)
        sigma = np.stack(
            [targets.sigma_row_px, targets.sigma_width_px, targets.sigma_spacing_px], axis=1
        )
        size_mm = np.stack([0.0 * targets.row, targets.size_mm, targets.spacing_mm], axis=1)
        return cls(
            range_mm=targets.range_mm,
            column_u=np.nan_to_num(design.normalised_column(targets.column)),
            measured=np.where(known, measured, 0.0),
            sigma=np.where(known, sigma, 1.0),
            known=known,
            per_pixel=np.where(known, size_mm, 0.0) / (design.pixel_um * 1e-3),
            sigma_range_mm=targets.sigma_range_mm,
            sigma_shared_mm=targets.sigma_shared_mm,
        )

    def __len__(self) -> int:
        return self.range_mm.size

    def select(self, which: NDArray[np.bool_]) -> Observed:
        """Return the targets where ``which`` is true."""
        return Observed(*(getattr(self, name)[which] for name in self.__slots__))

    def residual(self, p: Values) -> Array | None:
        """Return measured minus expected, px, shape (n, 3); ``None`` for an impossible build."""
        depth = self.range_mm + p["b_mm"]
        if not depth.min() > 0.0:
            return None
        expected = self.per_pixel * (p["k_mm"] / depth)[:, None]
        offset = p["b_prime_px"] + self.column_u * (
            p["b_prime_1_px"] + self.column_u * p["b_prime_2_px"]
        )
        expected[:, 0] = p["k_mm"] * p["k_prime_px"] / depth - offset
        expected[:, 1] += p[WIDTH_BIAS]
        return np.where(self.known, self.measured - expected, 0.0)

    def derivative(self, p: Values, names: Sequence[str]) -> Array:
        """Return the expected channels' derivatives by the named parameters, shape (n, 3, p)."""
        depth = self.range_mm + p["b_mm"]
        made = np.zeros((len(self), _CHANNELS, len(names)))
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
        """Return the Cholesky factors of the channels' covariances, shape (n, 3, 3)."""
        gradient = self.derivative(p, ["b_mm"])[:, :, 0] * self.sigma_range_mm[:, None]
        square = gradient[:, :, None] * gradient[:, None, :]
        diagonal = np.arange(_CHANNELS)
        square[:, diagonal, diagonal] += self.sigma * self.sigma
        return np.asarray(np.linalg.cholesky(square))


class Problem:
    """Whitened residuals of targets, then of priors, and their derivatives.

    - ``design``: Values of parameters that stay fixed, centres of the priors.
    - ``names``: Free parameters.
    - ``priors``: Standard deviations.
    - ``at``: Parameters at which the targets' covariances are evaluated.
    """

    def __init__(
        self,
        observed: Observed,
        design: RangeModel,
        names: tuple[str, ...],
        priors: Mapping[str, float],
        at: Values,
    ) -> None:
        self.observed, self.names, self.priors = observed, names, dict(priors)
        self.root = observed.root_covariance(at)
        self.sigma_px = np.linalg.norm(self.root, axis=2)
        self._whitener = np.linalg.inv(self.root)
        self._fixed = values_of(design)
        self._centre = np.array([self._fixed[name] for name in self.priors])
        self._spread = np.array(list(self.priors.values()))
        self._which = [names.index(name) for name in self.priors]
        self._rows = observed.known.ravel()

    def values(self, free: Array) -> Values:
        """Return all parameters by name from the free ones."""
        return self._fixed | dict(zip(self.names, free.tolist(), strict=True))

    def free(self, values: Mapping[str, float]) -> Array:
        """Return the free parameters in the order of ``names``."""
        return np.array([values[name] for name in self.names])

    def residual(self, free: Array) -> Array | None:
        """Return (expected - measured) / sigma; ``None`` for an impossible build."""
        p = self.values(free)
        possible = p["k_mm"] > 0.0 > p["k_prime_px"] and p["b_prime_px"] <= -POLE_MARGIN_PX
        white = self.whitened(p)
        if not (possible and np.isfinite(white).all()):
            return None
        prior = (free[self._which] - self._centre) / self._spread
        return np.concatenate([-white.ravel()[self._rows], prior])

    def jacobian(self, free: Array) -> Array:
        """Return the derivatives of `residual`."""
        direct = self.observed.derivative(self.values(free), self.names)
        white = np.einsum("nij,njp->nip", self._whitener, direct)
        prior = np.zeros((len(self.priors), len(self.names)))
        prior[np.arange(len(self.priors)), self._which] = 1.0 / self._spread
        return np.concatenate([white.reshape(-1, len(self.names))[self._rows], prior])

    def shared(self, values: Values) -> Array:
        """Return the derivatives of `residual` by the shared error in standard deviations."""
        direct = self.observed.derivative(values, ["b_mm"])[:, :, 0]
        direct = direct * self.observed.sigma_shared_mm[:, None]
        white = np.einsum("nij,nj->ni", self._whitener, direct)
        return np.concatenate([white.ravel()[self._rows], np.zeros(len(self.priors))])

    def whitened(self, values: Values) -> Array:
        """Return (measured - expected) / sigma, shape (n, 3); infinite for an impossible build."""
        residual = self.observed.residual(values)
        if residual is None:
            return np.full(self.observed.measured.shape, np.inf)
        return np.asarray(np.einsum("nij,nj->ni", self._whitener, residual))

    def leverage(self, values: Values, covariance: Array) -> Array:
        """Return the covariance of the whitened expected channels, shape (n, 3, 3)."""
        direct = self.observed.derivative(values, self.names)
        white = np.einsum("nij,njp->nip", self._whitener, direct)
        white = np.where(self.observed.known[:, :, None], white, 0.0)
        return np.asarray(np.einsum("nip,pq,njq->nij", white, covariance, white))


def condition_number(jacobian: Array) -> float:
    """Return largest over smallest singular value with columns of unit length.

    The units of the parameters do not matter. Infinite for a Jacobian that lacks rank.
    """
    scaled, _ = _unit_columns(jacobian)
    if scaled.shape[0] < scaled.shape[1]:
        return float("inf")
    singular = np.linalg.svd(scaled, compute_uv=False)
    if singular[-1] <= _RANK_TOLERANCE * singular[0]:
        return float("inf")
    return float(singular[0] / singular[-1])


def covariance(jacobian: Array) -> Array:
    """Return ``(J^T J)^-1`` of a Jacobian of full rank.

    ``J^T J`` itself, which squares the condition number, is not formed.
    """
    scaled, length = _unit_columns(jacobian)
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    root = right.T / singular / length[:, None]
    return np.asarray(root @ root.T)


def _unit_columns(jacobian: Array) -> tuple[Array, Array]:
    length = np.linalg.norm(jacobian, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    return jacobian / length, length
