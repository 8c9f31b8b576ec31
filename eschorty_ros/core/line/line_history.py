"""What changes with the line from profile to profile, by block of columns, and moves its rows.

A line whose rows are where they were has the same error in all profiles. One that moves is behind
by a part of a row, as pixels remember where it was, in all columns alike. One that gets narrower
for a few profiles passes an edge, and is off by half of the rows that are missing at most. Means
over blocks show changes that are too small to be seen in a column.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.scatter import BLOCK_COLUMNS

# Most that a moving line is behind, as the pixels of the simulation remember: 0.035 to 0.067 px.
SIGMA_COMMON_PX = 0.04
# Profiles whose mean a profile is compared with.
_PROFILES = 16.0
# Most that an edge moves the row per change of the width: by half of the rows that are missing, or
# by half of the gap in the middle of evenly lit rows.
PER_NARROWER = np.sqrt(3.0)
_PER_WIDER = 2.0 / np.sqrt(3.0)


class BlockSums(NamedTuple):
    """Sums over the points of a profile by block: rows, widths, variances of rows, and points."""

    row: NDArray[np.float64]
    width: NDArray[np.float64]
    sigma2: NDArray[np.float64]
    points: NDArray[np.float64]


class BlockMeans(NamedTuple):
    """Mean row and width of recent profiles by block, and the number of these profiles."""

    row: NDArray[np.float64]
    width: NDArray[np.float64]
    profiles: NDArray[np.float64]


class LineHistory(NamedTuple):
    """Sums of a profile and means of the recent ones, and the variances that follow from them.

    The first and the last block are outside the sensor. A line that moves is off by the standard
    deviation ``common_px`` at most: the variance ``moved2``; ``passing2`` is that of an edge that
    it passes.
    """

    now: BlockSums
    recent: BlockMeans
    moved2: NDArray[np.float64]
    passing2: NDArray[np.float64]
    common_px: float
    windowed: bool


def empty_history(columns: int, common_px: float, windowed: bool) -> LineHistory:
    """Return the history of a line before its first profile.

    That of full columns, not ``windowed``, is not followed: their widths are those of background.
    """
    blocks = -(-columns // BLOCK_COLUMNS) + 2
    now, recent = BlockSums(*np.zeros((4, blocks))), BlockMeans(*np.zeros((3, blocks)))
    moved2, passing2 = np.zeros((2, blocks))
    return LineHistory(now, recent, moved2, passing2, common_px, windowed)


@kernel(_nrt=False)
def _compare_with_recent(history, known, usual, width_variance):
    """Compare the sums of a profile with recent profiles, and add them.

    A line that has its ``usual`` width again, where it is ``known``, has passed the edge.
    """
    now, recent = history.now, history.recent
    for block in range(1, now.points.size - 1):
        near = slice(block - 1, block + 2)
        points, profiles = now.points[near].sum(), recent.profiles[block]
        history.moved2[block], history.passing2[block] = history.common_px**2, 0.0
        if points == 0.0 or not history.windowed:
            continue
        row, width = now.row[near].sum() / points, now.width[near].sum() / points
        moved = row - recent.row[block] if profiles > 0.0 else np.inf
        moved2 = moved * moved - now.sigma2[near].sum() / (points * points)
        narrower = min(recent.width[block], usual) - width
        wider = width - max(recent.width[block], usual)
        shift = max(PER_NARROWER * narrower, _PER_WIDER * wider, 0.0) if known else 0.0
        passing2 = shift * shift - PER_NARROWER**2 * width_variance / points
        history.moved2[block] = min(max(moved2, 0.0), history.common_px**2)
        history.passing2[block] = max(passing2, 0.0)
        profiles = min(profiles + 1.0, _PROFILES)
        # The first profiles, of pixels just lit, are soon forgotten.
        weight = 2.0 / (profiles + 1.0)
        recent.row[block] += weight * (row - recent.row[block])
        recent.width[block] += weight * (width - recent.width[block])
        recent.profiles[block] = profiles
