"""What changes with the line from profile to profile, by block of columns, and moves its rows.

A line whose rows are where they were has the same error in all profiles. One that moves is off by
a part of a row, as pixels remember where it was, in all columns alike: they give ON events ahead of
its centre and OFF events behind it. Where both are as far, the line is in the middle of their two
rows. The mean of all events is nearer to the kind with more of them, and its distance from the
middle is its uncertainty, up to the displacement of the line from profile to profile, which is that
of events of one kind alone.

Rows that jump back and forth, all columns alike, have successive differences of opposite sign.
The mean square of the smaller one, with that sign, shows the variance of the jumps; a steady
displacement has none, nor has a single jump to another surface.

A line that gets narrower or wider for a few profiles passes an edge, and is off by half of the rows
that are missing, or new, at most. Means over blocks show changes that are too small to be seen in a
column. Stripes change the mean width of recent profiles, too: the last width that was steady shows
their edges. At an edge the row moves with the width: what does not, or moves by far more, is light
that changes, or a surface that slopes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS, _near_sum
from eschorty_ros.core.line.window import POLARITY, ROW_LAST, ROW_MASK, _limits, _padded_end

# Larger differences from profile to profile are those of another surface, unless all columns have
# them.
_JITTER_MAX_PX = 1.0
# Variance of independent jumps over what the smaller of two successive differences shows of it.
_JITTER_PER_BACK = 1.5
# Profiles whose mean a profile is compared with.
RECENT_PROFILES = 16.0
# A width or row is the same while it changes by this many deviations at most, and steady when it
# has been so for more than two profiles.
STEADY = 2.0 * np.sqrt(2.0)
STEADY_PROFILES = 2.0
# Most that an edge moves the row per change of the width of evenly lit rows: by half of those that
# are missing, or by half of those that are new.
PER_WIDTH = np.sqrt(3.0)
# A row that moves by so many times what the width explains is that of a line that moves.
_MOVES = 8.0


class BlockSums(NamedTuple):
    """Sums over the points of a profile by block: rows, widths, variances of rows, and points.

    The row has ``moved`` since the last profile, in those columns that are ``in_both``.
    """

    row: NDArray[np.float64]
    width: NDArray[np.float64]
    sigma2: NDArray[np.float64]
    points: NDArray[np.float64]
    moved: NDArray[np.float64]
    in_both: NDArray[np.float64]


class BlockMeans(NamedTuple):
    """Mean row and width of recent profiles by block, and the number of these profiles.

    The ``width_row`` is the mean of rows that follow as slowly as the ``width`` does at an edge.
    The ``last`` row is that of the last profile, ``difference`` that from the one before it, and
    ``jitter2`` the variance of rows that jump back and forth. The ``same_width`` has been the same
    for ``same`` profiles; ``steady_width``, of ``before`` profiles ago, is the last that was for
    some, and ``steady_row`` the row then, NaN on another surface.
    """

    row: NDArray[np.float64]
    width: NDArray[np.float64]
    width_row: NDArray[np.float64]
    profiles: NDArray[np.float64]
    last: NDArray[np.float64]
    difference: NDArray[np.float64]
    jitter2: NDArray[np.float64]
    same_width: NDArray[np.float64]
    steady_width: NDArray[np.float64]
    steady_row: NDArray[np.float64]
    same: NDArray[np.float64]
    before: NDArray[np.float64]


class PolarityMeans(NamedTuple):
    """By block, how far the ``row`` of a moving line is from the middle of ON and OFF events.

    It is a mean over recent ``columns``. The number ``all_columns`` is of moving and still ones.
    """

    row: NDArray[np.float64]
    columns: NDArray[np.float64]
    all_columns: NDArray[np.float64]


class LineHistory(NamedTuple):
    """Sums of a profile and means of the recent ones, and the variances that follow from them.

    The first and the last block are outside the sensor. The line moves by ``step_px`` from profile
    to profile, a mean over recent ones. A line that moves is off by what the rows of its
    ``polarities`` show, at most. With what its bursts show, ``shift_px``, that is the variance
    ``moved2``; ``passing2`` is that of an edge that it passes.
    """

    now: BlockSums
    recent: BlockMeans
    polarities: PolarityMeans
    step_px: NDArray[np.float64]
    shift_px: NDArray[np.float64]
    moved2: NDArray[np.float64]
    passing2: NDArray[np.float64]


def empty_history(columns: int) -> LineHistory:
    """Return the history of a line before its first profile."""
    blocks = -(-columns // BLOCK_COLUMNS) + 2
    now, recent = BlockSums(*np.zeros((6, blocks))), BlockMeans(*np.zeros((12, blocks)))
    polarities = PolarityMeans(*np.zeros((3, blocks)))
    step_px, shift_px, moved2, passing2 = np.zeros((4, blocks))
    return LineHistory(now, recent, polarities, step_px, shift_px, moved2, passing2)


@kernel
def _restart_history(history):
    """Clear the means of recent profiles, and what follows from them."""
    for values in history.recent:
        values[:] = 0.0
    for values in history.polarities:
        values[:] = 0.0
    history.step_px[:], history.passing2[:], history.shift_px[:] = 0.0, 0.0, 0.0


@kernel(_nrt=False)
def _polarity_row(packed, start, seed, half):
    """Return how far the row of a column's events is from the middle of those of ON and OFF ones.

    NaN where one of the two is missing within ``half`` of the ``seed``.
    """
    first, last = _limits(seed, half, 0, ROW_LAST)
    base, span, none = np.uint32(first), np.uint32(last - first), np.uint32(0)
    on, off, on_rows, off_rows = none, none, none, none
    for i in range(np.uintp(start), _padded_end(packed, start)):
        row = packed[i] & ROW_MASK
        inside = np.uint32(row - base) <= span
        is_on = (packed[i] & POLARITY) > 0
        on = np.uint32(on + np.uint32(inside & is_on))
        on_rows = np.uint32(on_rows + (row if inside & is_on else none))
        off = np.uint32(off + np.uint32(inside & (not is_on)))
        off_rows = np.uint32(off_rows + (row if inside & (not is_on) else none))
    if min(on, off) == 0:
        return np.nan
    return (on_rows + off_rows) / (on + off) - 0.5 * (on_rows / on + off_rows / off)


@kernel(_nrt=False)
def _compare_polarities(columns, half, first, history):
    """Add one column of each block, its ``first`` one, to the polarities."""
    mean = history.polarities
    for block in range(1, mean.row.size - 1):
        c = np.uintp((block - 1) * BLOCK_COLUMNS + first)
        if c >= columns.seeds.size or columns.seeds[c] < 0:
            continue
        row = _polarity_row(columns.packed, columns.starts[c], columns.seeds[c], half)
        if np.isnan(row):
            # Background has the other polarity now and then: most columns decide.
            mean.all_columns[block] = max(mean.all_columns[block] - 1.0, 0.0)
            continue
        mean.all_columns[block] = min(mean.all_columns[block] + 1.0, RECENT_PROFILES)
        if history.step_px[block] > 0.0:
            mean.columns[block] = min(mean.columns[block] + 1.0, RECENT_PROFILES)
            mean.row[block] += (row - mean.row[block]) / mean.columns[block]


@kernel(_nrt=False)
def _has_one_polarity(polarities, block):
    """Return whether no column near a block has had events of both polarities."""
    return _near_sum(polarities.all_columns, block) == 0.0


@kernel
def _same_for(width, mean, profiles, sigma):
    """Return the mean of the widths that are the same, this one included, and their number.

    Their ``mean`` so far is compared: a width that changes slowly is not the same for long.
    """
    if not abs(width - mean) <= STEADY * sigma:
        return width, 1.0
    return mean + (width - mean) / (profiles + 1.0), profiles + 1.0


@kernel
def _changed_at_edge(changed, moved):
    """Return by how much an edge has ``changed`` a width, as far as the row has ``moved`` with it.

    That is up to twice what the row explains, as rows and widths are smoothed differently. A row of
    another surface, NaN, does not show it.
    """
    explained = abs(moved) / PER_WIDTH
    if explained > _MOVES * changed:
        return 0.0
    return changed if np.isnan(explained) else min(changed, 2.0 * explained)


@kernel(_nrt=False)
def _changed_since_steady(recent, block, row, width, width2):
    """Return by how much an edge has changed the last width that was the same for some profiles.

    ``width2`` is the variance of a block's mean width.
    """
    recent.same_width[block], recent.same[block] = _same_for(
        width, recent.same_width[block], recent.same[block], np.sqrt(width2)
    )
    recent.before[block] += 1.0
    if abs(row - recent.last[block]) > width:
        recent.steady_row[block] = np.nan
    if recent.same[block] > STEADY_PROFILES:
        recent.steady_width[block], recent.before[block] = recent.same_width[block], 0.0
        recent.steady_row[block] = row
    known = recent.steady_width[block] > 0.0 and recent.before[block] <= RECENT_PROFILES
    changed = abs(width - recent.steady_width[block]) if known else 0.0
    return _changed_at_edge(changed, row - recent.steady_row[block])


@kernel(_nrt=False)
def _moved(now, block):
    """Return by how much the rows near a block have moved since the last profile; 0 if not known.

    Of columns that have a point in one of both alone, a sloping surface has other rows.
    """
    return _near_sum(now.moved, block) / max(_near_sum(now.in_both, block), 1.0)


@kernel(_nrt=False)
def _move_alike(now, recent):
    """Return whether blocks have moved together since the last profile, as where the unit shakes.

    Then most of the mean square of their displacements is that of the mean.
    """
    blocks, total, squares = 0, 0.0, 0.0
    for block in range(1, now.points.size - 1):
        if _near_sum(now.points, block) > 0.0 and recent.profiles[block] > 0.0:
            difference = _moved(now, block)
            blocks += 1
            total += difference
            squares += difference * difference
    return 2.0 * total * total > blocks * squares


@kernel(_nrt=False)
def _motion_variance(history, block, row, own2, weight):
    """Return the variance of the rows of a line that moves, px squared.

    ``own2`` is the variance of the block's mean ``row``, and ``weight`` that of the profile among
    the recent ones, whose mean follows the line by as much as it moves from one to the next.
    """
    polarities = history.polarities
    moved = row - history.recent.row[block]
    moved2 = moved * moved - own2
    apart = weight * abs(moved) if moved2 > 0.0 else 0.0
    history.step_px[block] = apart
    if not _has_one_polarity(polarities, block):
        compared = 0
        for other in range(block - 1, block + 2):
            compared += polarities.columns[other] > 0.0
        apart = min(apart, abs(_near_sum(polarities.row, block)) / max(compared, 1))
    shift_px = history.shift_px[block]
    return min(max(moved2, 0.0), apart * apart) + shift_px * shift_px


@kernel(_nrt=False)
def _jitter_variance(recent, block, difference, own2, weight, alike):
    """Return the variance of rows that jump back and forth, px squared; see `_motion_variance`.

    Jumps of more than a row count where blocks move ``alike``.
    """
    before = recent.difference[block]
    near = max(abs(difference), abs(before)) < _JITTER_MAX_PX
    if (near or alike) and recent.profiles[block] > 1.0:
        # The smaller of the two: one large jump alone is another surface.
        back = -np.sign(difference * before) * min(abs(difference), abs(before)) ** 2
        recent.jitter2[block] += weight * (_JITTER_PER_BACK * back - recent.jitter2[block])
    recent.difference[block] = difference
    return max(recent.jitter2[block] - own2, 0.0)


@kernel(_nrt=False)
def _edge_variance(recent, block, row, width, width2, known, usual):
    """Return the variance of rows near an edge that passes, px squared.

    It is 0 while no usual width, or no recent one, is ``known``. A line that has its ``usual``
    width again for some profiles has passed the edge. ``width2`` is the variance of the block's
    mean ``width``.
    """
    least, most = min(recent.width[block], usual), max(recent.width[block], usual)
    since_steady = _changed_since_steady(recent, block, row, width, width2)
    moved = row - recent.width_row[block]
    moved = moved if abs(moved) < width else np.nan
    recently = _changed_at_edge(max(least - width, width - most), moved)
    changed = max(recently, since_steady) if known else 0.0
    return max(PER_WIDTH**2 * (changed * changed - width2), 0.0)


@kernel(_nrt=False)
def _compare_with_recent(history, known, usual, width_variance):
    """Compare the mean rows and widths of a profile with those of recent profiles, and add them.

    The ``usual`` width is ``known`` after some profiles.
    """
    now, recent = history.now, history.recent
    alike = _move_alike(now, recent)
    for block in range(1, now.points.size - 1):
        points = _near_sum(now.points, block)
        history.moved2[block], history.passing2[block], history.step_px[block] = 0.0, 0.0, 0.0
        if points == 0.0:
            continue
        row, width = _near_sum(now.row, block) / points, _near_sum(now.width, block) / points
        own2, width2 = _near_sum(now.sigma2, block) / (points * points), width_variance / points
        compared = known and recent.profiles[block] > 0.0
        history.passing2[block] = _edge_variance(recent, block, row, width, width2, compared, usual)
        profiles = min(recent.profiles[block] + 1.0, RECENT_PROFILES)
        # The first profiles, of pixels just lit, soon count little.
        weight = 2.0 / (profiles + 1.0)
        limit = np.inf
        if profiles > 1.0:
            moved2 = _motion_variance(history, block, row, own2, weight)
            jitter2 = _jitter_variance(recent, block, _moved(now, block), own2, weight, alike)
            history.moved2[block] = moved2 + jitter2
            # What an edge that passes changes at once is no scatter, and counts little.
            limit = RECENT_PROFILES / profiles * np.sqrt(width2) if known else limit
        recent.last[block], recent.profiles[block] = row, profiles
        recent.row[block] += weight * (row - recent.row[block])
        wider = width - recent.width[block]
        weight *= limit / abs(wider) if abs(wider) > limit else 1.0
        recent.width[block] += weight * wider
        recent.width_row[block] += weight * (row - recent.width_row[block])


@kernel(_nrt=False)
def _mean_of_blocks(values, points):
    """Return the mean of ``values`` over the blocks that have ``points``."""
    blocks, total = 0, 0.0
    for block in range(1, points.size - 1):
        if points[block] > 0.0:
            blocks += 1
            total += values[block]
    return total / max(blocks, 1)
