"""Which post is which: measured posts against a list of known distances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.calibration._post_lines import KnownTarget, LineSearch
from eschorty_ros.core.calibration.post_finder import Post
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.optics import RangeModel

_HINT_COLUMNS = 20.0
_HINT_ROWS = 30.0


@dataclass(frozen=True, slots=True)
class PostMatch:
    """Which posts are known targets, and what fits nothing.

    Attributes
    ----------
    targets : Targets or None
        The matched ones, nearest first; ``None`` when there are none.
    pairs : tuple of (int, int)
        Index of the post and of the known target, in the order of ``targets``.
    rejected : tuple of str
        One line for each post and each known target left over, with the reason.
    """

    targets: Targets | None
    pairs: tuple[tuple[int, int], ...]
    rejected: tuple[str, ...]


def match_posts(
    posts: Sequence[Post], known: Sequence[KnownTarget], nominal: RangeModel
) -> PostMatch:
    """Give every known target the post it is.

    A target with a pixel hint is the post nearest to the hint. The others follow from what the
    range equation demands whatever its constants: rows are a straight line in ``1 / (R + b)``.
    Of all lines through two posts whose ``kk'`` and ``b'`` lie near the nominal ones, the one that
    most posts agree with wins. Sizes, where known, rule out posts of another width.

    Parameters
    ----------
    posts : sequence of Post
    known : sequence of KnownTarget
    nominal : RangeModel
        The build as designed: ``kk'`` is trusted to 15 %, ``b'`` to 120 rows.

    Returns
    -------
    PostMatch

    Raises
    ------
    ArgumentError
        When nothing is known, or two known targets have the same range and no hints.
    FitError
        When the posts agree with the known ranges in more than one way.
    """
    if not known:
        raise ArgumentError("known is empty; give the targets' ranges")
    reasons: dict[int, str] = {}
    pairs = _by_hint(posts, known, reasons)
    free_posts = [
        i for i, post in enumerate(posts)
        if i not in reasons and i not in {p for p, _ in pairs} and not post.row_cut
    ]  # fmt: skip
    free_known = [j for j, target in enumerate(known) if not target.hinted]
    _refuse_equal_ranges([known[j] for j in free_known])
    search = LineSearch([posts[i] for i in free_posts], [known[j] for j in free_known], nominal)
    found = search.best()
    pairs += [(free_posts[i], free_known[j]) for i, j in found]
    pairs.sort(key=lambda pair: known[pair[1]].range_mm)
    rejected = _left_over(posts, known, pairs, reasons, search)
    return PostMatch(_targets(posts, known, pairs), tuple(pairs), rejected)


def _by_hint(
    posts: Sequence[Post], known: Sequence[KnownTarget], reasons: dict[int, str]
) -> list[tuple[int, int]]:
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
        if best is not None and posts[best[1]].row_cut:
            reasons[best[1]] = "the sensor's edge cuts its line"
        elif best is not None:
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


def _left_over(
    posts: Sequence[Post],
    known: Sequence[KnownTarget],
    pairs: Sequence[tuple[int, int]],
    reasons: dict[int, str],
    search: LineSearch,
) -> tuple[str, ...]:
    lines = []
    for i, post in enumerate(posts):
        if i in {p for p, _ in pairs}:
            continue
        reason = reasons.get(i)
        if reason is None and post.row_cut:
            reason = "the sensor's edge cuts its line"
        if reason is None:
            reason = "no known target belongs there"
        lines.append(f"post at column {post.column:.0f}, row {post.row:.1f}: {reason}")
    for j, target in enumerate(known):
        if j in {k for _, k in pairs}:
            continue
        row = search.row_of(target)
        if target.hinted:
            reason = "no whole post near its pixel hint"
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
    seen = [posts[i] for i, _ in pairs]
    true = [known[j] for _, j in pairs]
    return Targets(
        row=[post.row for post in seen],
        range_mm=[target.range_mm for target in true],
        sigma_row_px=[post.sigma_row for post in seen],
        sigma_range_mm=[target.sigma_range_mm for target in true],
        column=[math.nan if post.column_cut else post.column for post in seen],
        width_px=[math.nan if post.column_cut else post.width_px for post in seen],
        sigma_width_px=[post.sigma_width_px for post in seen],
        size_mm=[target.size_mm for target in true],
        labels=[target.label for target in true],
    )
