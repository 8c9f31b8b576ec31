"""Targets at known ranges, to which a calibration is fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array, reals, selection
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import short

SIGMA_ROW_PX = 0.3
"""Standard deviation of a centroid by default."""
SIGMA_WIDTH_PX = 0.4
"""Standard deviation of a width or a spacing, the difference of two edges or centres."""

_ALWAYS = ("row", "range_mm", "sigma_row_px", "sigma_range_mm", "sigma_shared_mm")
_SIZES = (
    ("width_px", "sigma_width_px", "size_mm"),
    ("spacing_px", "sigma_spacing_px", "spacing_mm"),
)
_POSITIVE_OR_UNKNOWN = tuple(name for names in _SIZES for name in names)


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Targets:
    """Rows of targets at known ranges, with their widths, spacings and standard deviations.

    Every argument is a scalar for all targets or one entry for each. Attributes are float64 of
    shape (n,) and read-only.

    Raises ``ArgumentError`` when an entry is not finite, of the wrong sign or missing; names the
    target.
    """

    row: Array
    """Where the targets appear, px, on the sensor."""
    range_mm: Array
    """Their ranges along the sheet from the mechanical datum, mm, positive."""
    sigma_row_px: Array
    sigma_range_mm: Array
    """Standard deviations; of a range 0 or more."""
    column: Array
    """Column in which the target has this row, px; NaN where unknown."""
    width_px: Array
    sigma_width_px: Array
    size_mm: Array
    """Columns that the lit target covers, its standard deviation, and the true size along the laser
    line; NaN where unknown. Blooming widens the image of a lit target."""
    spacing_px: Array
    sigma_spacing_px: Array
    spacing_mm: Array
    """Columns between the centres of two marks at this range, its standard deviation, and the true
    distance; NaN where unknown. Blooming does not move centres."""
    sigma_shared_mm: Array
    """Standard deviation of an error that is the same for the ranges of all these targets, such as
    that of one moved target; 0 or more. It adds to the covariance and to no residual."""
    labels: tuple[str, ...]
    """Names of the targets in messages and reports; ``1``, ``2``, ... by default."""

    def __init__(
        self,
        row: ArrayLike,
        range_mm: ArrayLike,
        sigma_row_px: ArrayLike = SIGMA_ROW_PX,
        sigma_range_mm: ArrayLike = 0.0,
        column: ArrayLike = math.nan,
        width_px: ArrayLike = math.nan,
        sigma_width_px: ArrayLike = SIGMA_WIDTH_PX,
        size_mm: ArrayLike = math.nan,
        spacing_px: ArrayLike = math.nan,
        sigma_spacing_px: ArrayLike = SIGMA_WIDTH_PX,
        spacing_mm: ArrayLike = math.nan,
        sigma_shared_mm: ArrayLike = 0.0,
        labels: Sequence[str] = (),
    ) -> None:
        given = (row, range_mm, sigma_row_px, sigma_range_mm, column, width_px, sigma_width_px,
                 size_mm, spacing_px, sigma_spacing_px, spacing_mm, sigma_shared_mm)  # fmt: skip
        size = np.atleast_1d(reals("row", row)).size
        for name, value in zip(_NUMBERS, given, strict=True):
            entries = reals(name, value)
            if entries.ndim > 1 or entries.size not in (1, size):
                raise ArgumentError(f"{name} has shape {entries.shape}; give one number or {size}")
            array = np.array(np.broadcast_to(entries, size))
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if not isinstance(labels, list | tuple):
            raise ArgumentError(f"labels is {short(labels)}; give {size} texts")
        named = tuple(labels) or tuple(str(index + 1) for index in range(size))
        if len(named) != size or not all(isinstance(label, str) for label in named):
            raise ArgumentError(f"labels holds {len(named)} entries; give {size} texts")
        object.__setattr__(self, "labels", named)
        self._check()

    def _check(self) -> None:
        for name in _ALWAYS:
            self._refuse(name, ~np.isfinite(getattr(self, name)), "give a finite number")
        self._refuse("range_mm", self.range_mm <= 0.0, "choose a positive range")
        self._refuse("sigma_row_px", self.sigma_row_px <= 0.0, "choose a positive number")
        for name in ("sigma_range_mm", "sigma_shared_mm"):
            self._refuse(name, getattr(self, name) < 0.0, "choose 0 or more")
        self._refuse("column", np.isinf(self.column), "give a finite number")
        for name in _POSITIVE_OR_UNKNOWN:
            value = getattr(self, name)
            self._refuse(name, np.isinf(value) | (value <= 0.0), "choose a positive number or NaN")
        for measured, sigma, _ in _SIZES:
            unknown = np.isfinite(getattr(self, measured)) & np.isnan(getattr(self, sigma))
            self._refuse(sigma, unknown, "choose a positive number")

    def __len__(self) -> int:
        return self.row.size

    @property
    def has_width(self) -> NDArray[np.bool_]:
        """Targets whose width and size are both known, shape (n,)."""
        return np.isfinite(self.width_px) & np.isfinite(self.size_mm)

    @property
    def has_spacing(self) -> NDArray[np.bool_]:
        """Targets whose spacing is known in columns and in mm, shape (n,)."""
        return np.isfinite(self.spacing_px) & np.isfinite(self.spacing_mm)

    @property
    def lateral(self) -> int:
        """Number of known sizes and spacings, which separate k from k'."""
        return int(self.has_width.sum() + self.has_spacing.sum())

    def select(self, which: ArrayLike) -> Targets:
        """Return the targets at these indices, or where this mask is true."""
        index = np.arange(len(self))[selection("which", which, len(self))]
        numbers = {name: getattr(self, name)[index] for name in _NUMBERS}
        return Targets(**numbers, labels=tuple(self.labels[i] for i in index))

    @staticmethod
    def concatenate(parts: Sequence[Targets]) -> Targets:
        """Return all targets of ``parts`` in their order, with their labels.

        Raises ``ArgumentError`` when there is nothing to join.
        """
        if not parts:
            raise ArgumentError("parts is empty; give at least one Targets")
        numbers = {n: np.concatenate([getattr(part, n) for part in parts]) for n in _NUMBERS}
        return Targets(**numbers, labels=tuple(label for part in parts for label in part.labels))

    def _refuse(self, name: str, wrong: NDArray[np.bool_], remedy: str) -> None:
        if wrong.any():
            index = int(np.flatnonzero(wrong)[0])
            value = getattr(self, name)[index]
            raise ArgumentError(f"{name} of target {self.labels[index]} is {value:g}; {remedy}")


_NUMBERS = tuple(item.name for item in fields(Targets) if item.name != "labels")
