"""The straight line in ``1 / (R + b)`` that most posts and known targets agree on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eschorty_ros.core.base.arrays import number, number_or_nan, positive
from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration.post_finder import Post
from eschorty_ros.core.optics import RangeModel

SCALE_TOLERANCE = 0.15
"""By this share kk' may differ from the nominal build's."""
OFFSET_TOLERANCE_PX = 120.0
"""By this many rows b' may."""
_SIZE_TOLERANCE = 0.3
_ROW_TOLERANCE_PX = 3.0
_SIGMAS = 5.0
# Another assignment must be this many times worse, in squared shares of the tolerance.
_CLEARLY, _CLOSE = 4.0, 0.02


@dataclass(frozen=True, slots=True)
class KnownTarget:
    """A target of known range.

    Parameters
    ----------
    range_mm, sigma_range_mm : float
        Range of its front along the sheet from the mechanical datum, and how well it is known.
    size_mm : float
        Width along the laser line; NaN when unknown.
    column, row : float
        Where it should be seen, px; NaN when anywhere.
    label : str
        What messages call it; its range by default.

    Raises
    ------
    ArgumentError
        For a range or size that is not positive.
    """

    range_mm: float
    sigma_range_mm: float = 0.0
    size_mm: float = math.nan
    column: float = math.nan
    row: float = math.nan
    label: str = ""

    def __post_init__(self) -> None:
        positive("range_mm", self.range_mm)
        number("sigma_range_mm", self.sigma_range_mm, 0.0)
        for name in ("size_mm", "column", "row"):
            number_or_nan(name, getattr(self, name))
        if self.size_mm <= 0.0:
            raise ArgumentError(f"size_mm is {self.size_mm!r}; choose a positive number or NaN")
        if not isinstance(self.label, str):
            raise ArgumentError(f"label is {self.label!r}; give a text")
        if not self.label:
            object.__setattr__(self, "label", f"{self.range_mm:g} mm")

    @property
    def hinted(self) -> bool:
        """Whether it says where it should be seen."""
        return not (math.isnan(self.column) and math.isnan(self.row))


class LineSearch:
    """Lines ``row = slope / (R + b) + offset`` through two posts each, and who agrees with them."""

    def __init__(
        self, posts: Sequence[Post], known: Sequence[KnownTarget], nominal: RangeModel
    ) -> None:
        self._nominal = nominal
        self._row = np.array([post.row for post in posts])
        self._inverse = 1.0 / (np.array([t.range_mm for t in known]) + nominal.b_mm)
        sigma_row = np.array([post.sigma_row for post in posts])
        slope = -nominal.product_mm_px * self._inverse**2
        sigma_range = slope * np.array([target.sigma_range_mm for target in known])
        spread = np.hypot(sigma_row[:, np.newaxis], sigma_range[np.newaxis, :])
        self._tolerance = np.maximum(_SIGMAS * spread, _ROW_TOLERANCE_PX)
        self._allowed = np.array(
            [[_size_fits(post, target, nominal) for target in known] for post in posts], bool
        ).reshape(len(posts), len(known))
        self.line: tuple[float, float] | None = None

    def best(self) -> list[tuple[int, int]]:
        """Return the pairs most posts agree with."""
        found: dict[tuple[tuple[int, int], ...], float] = {}
        for first, second, slope, offset in self._lines():
            pairs = self._agreeing(slope, offset)
            if (first not in pairs) or (second not in pairs):
                continue
            key = tuple(pairs)
            found[key] = self._misfit(key)[0]
        if not found:
            return []
        most = max(len(pairs) for pairs in found)
        ranked = sorted((misfit, pairs) for pairs, misfit in found.items() if len(pairs) == most)
        least, best = ranked[0]
        if len(ranked) > 1 and ranked[1][0] < _CLEARLY * least + _CLOSE:
            raise FitError(
                f"{most} posts agree with the known ranges in more than one way; give sizes, "
                "pixel hints, or posts at uneven distances"
            )
        _, slope, offset = self._misfit(best)
        self.line = slope, offset
        return list(best)

    def row_of(self, target: KnownTarget) -> float:
        """Row at which ``target`` should be seen by the line found, NaN without one."""
        if self.line is None:
            return math.nan
        return self.line[0] / (target.range_mm + self._nominal.b_mm) + self.line[1]

    def _lines(self) -> list[tuple[tuple[int, int], tuple[int, int], float, float]]:
        """Every line through two pairs that a build near the nominal one could have."""
        low, high = (self._nominal.product_mm_px * (1.0 + side * SCALE_TOLERANCE)
                     for side in (1, -1))  # fmt: skip
        candidates = np.argwhere(self._allowed)
        lines = []
        for k, (i, j) in enumerate(candidates):
            others = candidates[k + 1 :]
            rise = self._row[others[:, 0]] - self._row[i]
            run = self._inverse[others[:, 1]] - self._inverse[j]
            slope = np.divide(rise, run, out=np.full(rise.shape, np.nan), where=run != 0.0)
            offset = self._row[i] - slope * self._inverse[j]
            plausible = (low <= slope) & (slope <= high) & (others[:, 0] != i)
            plausible &= np.abs(offset + self._nominal.b_prime_px) <= OFFSET_TOLERANCE_PX
            for at in np.flatnonzero(plausible).tolist():
                pair = int(others[at, 0]), int(others[at, 1])
                lines.append(((int(i), int(j)), pair, float(slope[at]), float(offset[at])))
        return lines

    def _agreeing(self, slope: float, offset: float) -> list[tuple[int, int]]:
        """Pairs within their tolerance of the line, nearest first, each post and target once."""
        away = np.abs(self._row[:, np.newaxis] - (slope * self._inverse + offset)[np.newaxis, :])
        away = np.where(self._allowed, away / self._tolerance, np.inf)
        pairs: list[tuple[int, int]] = []
        posts, targets = set(), set()
        close = np.argwhere(away <= 1.0)
        for i, j in close[np.argsort(away[close[:, 0], close[:, 1]], kind="stable")].tolist():
            if i not in posts and j not in targets:
                posts.add(i)
                targets.add(j)
                pairs.append((i, j))
        return sorted(pairs)

    def _misfit(self, pairs: Sequence[tuple[int, int]]) -> tuple[float, float, float]:
        """Mean squared share of the tolerance about the pairs' own line; its slope, offset."""
        i, j = np.array(pairs).T
        centre = float(self._inverse[j].mean())
        at = self._inverse[j] - centre
        slope = float((at * self._row[i]).sum() / (at * at).sum())
        offset = float(self._row[i].mean()) - slope * centre
        residual = (self._row[i] - slope * self._inverse[j] - offset) / self._tolerance[i, j]
        return float((residual**2).mean()), slope, offset


def _size_fits(post: Post, target: KnownTarget, nominal: RangeModel) -> bool:
    if math.isnan(target.size_mm) or post.column_cut:
        return True
    magnified = nominal.k_mm / (target.range_mm + nominal.b_mm)
    expected = target.size_mm * magnified / (nominal.pixel_um * 1e-3)
    slack = _SIZE_TOLERANCE * expected + _SIGMAS * post.sigma_width_px
    return abs(post.width_px - expected) <= slack
