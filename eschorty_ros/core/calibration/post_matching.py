"""Matching of measured posts to a list of known distances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.base.numbers import number, number_or_nan, positive
from eschorty_ros.core.calibration.post_finder import Post
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import RangeModel

_HINT_COLUMNS = 20.0
_HINT_ROWS = 30.0
# Largest deviation of kk' (a share) and b' (rows) from the nominal build's.
_SCALE_TOLERANCE = 0.15
_OFFSET_TOLERANCE_PX = 120.0
_SIZE_TOLERANCE = 0.3
_ROW_TOLERANCE_PX = 3.0
_SIGMAS = 5.0
# Another assignment must be worse by this factor and this sum, in squared shares of the tolerance.
_CLEARLY, _CLOSE = 4.0, 0.02
# Share of the posts, or of the known ones where these are fewer, that chance does not make agree.
_AGREE_MIN = 2 / 3


@dataclass(frozen=True, slots=True)
class KnownTarget:
    """A target of known range.

    Raises ``ArgumentError`` for a range or size that is not positive.
    """

    range_mm: float
    sigma_range_mm: float = 0.0
    """Range of its front along the sheet from the mechanical datum, and how well it is known."""
    size_mm: float = math.nan
    """Width along the laser line; NaN when unknown."""
    column: float = math.nan
    row: float = math.nan
    """Where it is expected, px; NaN where unknown."""
    label: str = ""
    """Its name in messages; its range by default."""

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
        """Return whether the column or row where it is expected is known."""
        return not (math.isnan(self.column) and math.isnan(self.row))


@dataclass(frozen=True, slots=True)
class PostMatch:
    """Posts matched to known targets, and the unmatched ones of both."""

    targets: Targets | None
    """The matched ones, nearest first; ``None`` when there are none."""
    pairs: tuple[tuple[int, int], ...]
    """Index of the post and of the known target, in the order of ``targets``."""
    rejected: tuple[str, ...]
    """One line for each post and each known target left over, with the reason."""


def match_posts(
    posts: Sequence[Post], known: Sequence[KnownTarget], nominal: RangeModel
) -> PostMatch:
    """Find the post of every known target.

    A target with a pixel hint is the post nearest to the hint. The others follow from the range
    equation, which for any constants makes rows a straight line in ``1 / (R + b)``. Of all lines
    through two posts whose ``kk'`` and ``b'`` are near the nominal ones, the line that most posts
    agree with is used. Sizes, where known, exclude posts of another width.

    - ``nominal``: The build as designed: ``kk'`` holds within 15 %, ``b'`` within 120 rows.

    Raises ``ArgumentError`` when nothing is known, or two known targets have the same range and no
    hints. Raises ``FitError`` when the posts agree with the known ranges in more than one way, or
    as those of a camera that is upside down.
    """
    if not known:
        raise ArgumentError("known is empty; give the targets' ranges")
    pairs = _by_hint(posts, known)
    matched = {i for i, _ in pairs}
    free_posts = [i for i, post in enumerate(posts) if i not in matched and not post.row_cut]
    free_known = [j for j, target in enumerate(known) if not target.hinted]
    _refuse_equal_ranges([known[j] for j in free_known])
    free = [posts[i] for i in free_posts], [known[j] for j in free_known], nominal
    search = _LineSearch(*free)
    try:
        found = search.best()
    except FitError:
        _refuse_upside_down(*free)
        raise
    if not found:
        _refuse_upside_down(*free)
    pairs += [(free_posts[i], free_known[j]) for i, j in found]
    pairs.sort(key=lambda pair: known[pair[1]].range_mm)
    rejected = _left_over(posts, known, pairs, search)
    return PostMatch(_targets(posts, known, pairs), tuple(pairs), rejected)


def _refuse_upside_down(
    posts: Sequence[Post], known: Sequence[KnownTarget], nominal: RangeModel
) -> None:
    """Refuse posts that agree with the known ranges when the image is turned by 180 degrees."""
    turned = [
        replace(post, row=nominal.rows - 1 - post.row, column=nominal.columns - 1 - post.column)
        for post in posts
    ]
    try:
        agreeing = len(_LineSearch(turned, known, nominal).best())
    except FitError:
        return
    # A line goes through any two.
    if agreeing > 2:
        raise FitError(
            f"{agreeing} posts agree with the known ranges with the image turned by 180 degrees: "
            "turn a camera that is upside down; where rows are counted from the sensor's other end "
            f"write {nominal.rows - 1} - row"
        ) from None


def _by_hint(posts: Sequence[Post], known: Sequence[KnownTarget]) -> list[tuple[int, int]]:
    pairs: list[tuple[int, int]] = []
    for j, target in enumerate(known):
        if not target.hinted:
            continue
        best: tuple[float, int] | None = None
        for i, post in enumerate(posts):
            reach = max(_HINT_COLUMNS, 0.5 * post.width_px)
            aside = _share(post.column - target.column, reach)
            above = _share(post.row - target.row, _HINT_ROWS)
            taken = any(i == p for p, _ in pairs)
            if max(aside, above) <= 1.0 and not taken and (not best or aside + above < best[0]):
                best = aside + above, i
        if best is not None and not posts[best[1]].row_cut:
            pairs.append((best[1], j))
    return pairs


def _share(distance: float, reach: float) -> float:
    return 0.0 if math.isnan(distance) else abs(distance) / reach


def _refuse_equal_ranges(known: Sequence[KnownTarget]) -> None:
    ordered = sorted(known, key=lambda target: target.range_mm)
    for one, other in pairwise(ordered):
        if other.range_mm == one.range_mm:
            raise ArgumentError(
                f"targets {one.label} and {other.label} have the same range "
                f"{one.range_mm:g} mm; give both their columns"
            )


class _Line(NamedTuple):
    """Line ``row = slope / (R + b) + offset`` through pairs.

    ``misfit`` is the mean squared share of their tolerance.
    """

    slope: float
    offset: float
    misfit: float


class _LineSearch:
    """Lines ``row = slope / (R + b) + offset`` through two posts each, and the posts near them."""

    def __init__(
        self, posts: Sequence[Post], known: Sequence[KnownTarget], nominal: RangeModel
    ) -> None:
        self._nominal = nominal
        # Rows as in the principal column: roll and smile move the others.
        aside = nominal.row_offset_px([post.column for post in posts]) - nominal.b_prime_px
        self._row = np.array([post.row for post in posts]) + aside
        self._inverse = 1.0 / (np.array([t.range_mm for t in known]) + nominal.b_mm)
        sigma_row = np.array([post.sigma_row for post in posts])
        slope = -nominal.product_mm_px * self._inverse**2
        sigma_range = slope * np.array([target.sigma_range_mm for target in known])
        spread = np.hypot(sigma_row[:, np.newaxis], sigma_range[np.newaxis, :])
        self._tolerance = np.maximum(_SIGMAS * spread, _ROW_TOLERANCE_PX)
        self._allowed = np.array(
            [[_size_fits(post, target, nominal) for target in known] for post in posts], bool
        ).reshape(len(posts), len(known))
        self._line: _Line | None = None

    def best(self) -> list[tuple[int, int]]:
        """Return the pairs of the line that most posts agree with."""
        found: dict[tuple[tuple[int, int], ...], float] = {}
        for first, second, slope, offset in self._lines():
            pairs = self._agreeing(slope, offset)
            if (first not in pairs) or (second not in pairs):
                continue
            key = tuple(pairs)
            found[key] = self._fitted(key).misfit
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
        fewer = min(self._allowed.shape)
        if most < _AGREE_MIN * fewer:
            raise FitError(
                f"{most} of {fewer} posts agree with the known ranges, which any ranges may; check "
                "them, or give sizes or pixel hints"
            )
        self._line = self._fitted(best)
        return list(best)

    def row_of(self, target: KnownTarget) -> float:
        """Return the row of ``target`` in the principal column, NaN without a line."""
        if self._line is None:
            return math.nan
        return self._line.slope / (target.range_mm + self._nominal.b_mm) + self._line.offset

    def _lines(self) -> list[tuple[tuple[int, int], tuple[int, int], float, float]]:
        """Return every line through two pairs that is possible for a build near the nominal one."""
        low, high = (self._nominal.product_mm_px * (1.0 + side * _SCALE_TOLERANCE)
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
            plausible &= np.abs(offset + self._nominal.b_prime_px) <= _OFFSET_TOLERANCE_PX
            for at in np.flatnonzero(plausible).tolist():
                pair = int(others[at, 0]), int(others[at, 1])
                lines.append(((int(i), int(j)), pair, float(slope[at]), float(offset[at])))
        return lines

    def _agreeing(self, slope: float, offset: float) -> list[tuple[int, int]]:
        """Return pairs within their tolerance of the line, each post and target once.

        The nearest pairs are taken first.
        """
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

    def _fitted(self, pairs: Sequence[tuple[int, int]]) -> _Line:
        """Return the line that fits pairs best."""
        i, j = np.array(pairs).T
        centre = float(self._inverse[j].mean())
        at = self._inverse[j] - centre
        slope = float((at * self._row[i]).sum() / (at * at).sum())
        offset = float(self._row[i].mean()) - slope * centre
        residual = (self._row[i] - slope * self._inverse[j] - offset) / self._tolerance[i, j]
        return _Line(slope, offset, float((residual**2).mean()))


def _size_fits(post: Post, target: KnownTarget, nominal: RangeModel) -> bool:
    if math.isnan(target.size_mm) or post.column_cut:
        return True
    magnified = nominal.k_mm / (target.range_mm + nominal.b_mm)
    expected = target.size_mm * magnified / (nominal.pixel_um * 1e-3)
    slack = _SIZE_TOLERANCE * expected + _SIGMAS * post.sigma_width_px
    return abs(post.width_px - expected) <= slack


def _left_over(
    posts: Sequence[Post],
    known: Sequence[KnownTarget],
    pairs: Sequence[tuple[int, int]],
    search: _LineSearch,
) -> tuple[str, ...]:
    lines = []
    matched, found = ({pair[side] for pair in pairs} for side in (0, 1))
    for i, post in enumerate(posts):
        if i not in matched:
            reason = "it matches no known target"
            if post.row_cut:
                reason = "the sensor's edge cuts its line"
            lines.append(f"post at column {post.column:.0f}, row {post.row:.1f}: {reason}")
    for j, target in enumerate(known):
        if j in found:
            continue
        row = search.row_of(target)
        if target.hinted:
            reason = "no uncut post near its pixel hint"
        elif math.isnan(row):
            reason = "no two posts agree with the known ranges and the nominal build"
        else:
            reason = f"no fitting post near row {row:.1f}"
        lines.append(f"target {target.label}: {reason}")
    return tuple(lines)


def _targets(
    posts: Sequence[Post], known: Sequence[KnownTarget], pairs: Sequence[tuple[int, int]]
) -> Targets | None:
    if not pairs:
        return None
    measured = [posts[i] for i, _ in pairs]
    true = [known[j] for _, j in pairs]
    return Targets(
        row=[post.row for post in measured],
        range_mm=[target.range_mm for target in true],
        sigma_row_px=[post.sigma_row for post in measured],
        sigma_range_mm=[target.sigma_range_mm for target in true],
        # That of the row, also of a post whose middle the sensor's edge cuts off.
        column=[post.column for post in measured],
        width_px=[math.nan if post.column_cut else post.width_px for post in measured],
        sigma_width_px=[post.sigma_width_px for post in measured],
        size_mm=[target.size_mm for target in true],
        labels=[target.label for target in true],
    )
