"""How far the rows of early events of a burst are from those of the later ones.

All events of a line that is at rest and symmetric have the same mean row. Where a readout takes
fewer events than the pixels give, and loses them in the order of the rows, those at the height of
the burst have lost one side of the line, and the later ones have not. What the bursts of both
polarities show is an uncertainty of the row, and moves it to the late events; one of them alone
differs where pixels answer the two edges of the laser differently. A line that passes an edge has
lost one side, too, but not to the readout: the sums start again after the edge. Early events of a
line that moves are ahead of the late ones, as pixels that were lit before answer later, which is an
uncertainty but no fault.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS, _near_sum
from eschorty_ros.core.line.line_history import RECENT_PROFILES, _has_one_polarity
from eschorty_ros.core.line.window import (
    _ONE,
    _ONE_BITS,
    FRACTION,
    POLARITY,
    ROW_MASK,
    TIME_SHIFT,
    _padded_end,
)

# Share of the sums that the next profile keeps.
_KEPT = 1.0 - 1.0 / 16.0
# Length of a burst, of 2**32 per turn: what a moving line reaches or leaves later is none of it.
_BURST = 1 << 30
# Where late events begin, at first, and the share of its value by which an event moves that.
_LATE = 1 << 26
_STEP = 1.0 / 32.0
# Events of a column that move it together.
_STEP_EVENTS = np.uintp(32)
# Share of the events of a burst that are early.
_EARLY_SHARE = 0.75
# Difference of both parts over the standard deviation by which whole pixels move the mean row.
_EXPLAINED = 12.0
# Profiles without which a shift is chance. From then on one of as many is added.
_PROFILES_MIN = 4
# Standard deviations of a sum over blocks that chance may have; each column is in three of them.
_BY_CHANCE = 2.0 * np.sqrt(3.0)
# Least mean product of the shifts of both polarities, px squared: 0.0 to 0.2 where nothing is lost.
# Where an edge that passes adds more to the variance of the row, it may cause such shifts.
_PRODUCT_MIN = 0.5


class Followed(NamedTuple):
    """Numbers of points: all, with a shift that no motion explains, and of one polarity alone."""

    points: np.int64
    shifted: np.int64
    of_one_polarity: np.int64


class Bursts(NamedTuple):
    """Sums over recent profiles by block of columns, polarity and part of the burst.

    Early events, part 0, are before the phase ``late``, of 2**32 per turn. The first
    and the last block are outside the sensor. ``profiles`` is how many the sums of a block are of.
    """

    events: NDArray[np.float64]
    rows_px: NDArray[np.float64]
    late: NDArray[np.float64]
    profiles: NDArray[np.int64]


def empty_bursts(columns: int) -> Bursts:
    """Return no bursts."""
    blocks = -(-columns // BLOCK_COLUMNS) + 2
    events, rows_px = np.zeros((2, blocks, 2, 2))
    late = np.full((blocks, 2), float(_LATE))
    return Bursts(events, rows_px, late, np.zeros(blocks, np.int64))


@kernel(_nrt=True)
def _clear_bursts(bursts):
    bursts.events[:], bursts.rows_px[:] = 0.0, 0.0
    bursts.late[:], bursts.profiles[:] = _LATE, 0


@kernel(_nrt=False)
def _add_sums(bursts, block, polarity, early, late, origin_px):
    """Add numbers of events, and sums of their rows beside the origin, of both parts."""
    more_late = 0.0
    for part, both in ((0, early), (1, late)):
        n = np.int64(both >> _ONE_BITS)
        bursts.events[block, polarity, part] += n
        bursts.rows_px[block, polarity, part] += (
            np.int64(both & (_ONE - np.uint32(1))) + n * origin_px
        )
        more_late += n * _EARLY_SHARE if part else n * (_EARLY_SHARE - 1.0)
    bursts.late[block, polarity] *= 1.0 + _STEP * more_late


@kernel(_nrt=False)
def _add_column(packed, start, seed, half, blink, block, bursts):
    """Add the events of a column within ``half`` of its ``seed`` that are in a burst."""
    first = (seed - half + FRACTION - 1) // FRACTION
    base, span = np.uint32(first), np.uint32((seed + half) // FRACTION - first)
    late_on, late_off = np.uint32(bursts.late[block, 1]), np.uint32(bursts.late[block, 0])
    none = np.uint32(0)
    begin, padded = np.uintp(start), _padded_end(packed, start)
    while begin < padded:
        # The number of some events and the sum of their rows share a register.
        on_early, on_late, off_early, off_late = none, none, none, none
        end = min(begin + _STEP_EVENTS, padded)
        for i in range(begin, end):
            v = packed[i]
            d = np.uint32((v & ROW_MASK) - base)
            on = (v & POLARITY) > 0
            turn = np.uint32((v >> TIME_SHIFT) * blink.step)
            phase = np.uint32(turn - (none if on else blink.duty))
            late = phase >= (late_on if on else late_off)
            value = np.uint32(_ONE + d) if (d <= span) & (phase < _BURST) else none
            on_early = np.uint32(on_early + (value if on & (not late) else none))
            on_late = np.uint32(on_late + (value if on & late else none))
            off_early = np.uint32(off_early + (value if (not on) & (not late) else none))
            off_late = np.uint32(off_late + (value if (not on) & late else none))
        _add_sums(bursts, block, 1, on_early, on_late, first - seed / FRACTION)
        _add_sums(bursts, block, 0, off_early, off_late, first - seed / FRACTION)
        begin = end


@kernel(_nrt=False)
def _difference(bursts, block, polarity, explained_px):
    """Return how far early and late rows near a block differ beyond what is explained, px."""
    early = _near_sum(bursts.events[:, polarity, 0], block)
    late = _near_sum(bursts.events[:, polarity, 1], block)
    if min(early, late) < 1.0:
        return 0.0
    early_px = _near_sum(bursts.rows_px[:, polarity, 0], block) / early
    difference = early_px - _near_sum(bursts.rows_px[:, polarity, 1], block) / late
    return np.sign(difference) * max(abs(difference) - explained_px, 0.0)


@kernel(inline="always")
def _is_followed(history, block):
    """Return whether a block has had points for so long that its sums show losses."""
    return history.recent.profiles[block] >= RECENT_PROFILES


@kernel(inline="always")
def _lost_shift_px(history, block):
    """Return how far the early rows of a block are from the late ones by losses, px.

    Those of a line that moves are ahead of the late ones without losses.
    """
    moved_px = history.recent.last[block] - history.recent.row[block]
    ahead = history.step_px[block] > 0.0 and history.shift_px[block] * moved_px > 0.0
    return 0.0 if ahead else history.shift_px[block]


@kernel(_nrt=False)
def _use_late_rows(row, history):
    """Move rows to those of late events, of which the readout loses fewer."""
    returns, columns = row.shape
    for k in range(returns):
        for c in range(np.uintp(columns)):
            block = c // BLOCK_COLUMNS + 1
            if _is_followed(history, block):
                row[k, c] -= _EARLY_SHARE * _lost_shift_px(history, block)


@kernel(_nrt=False)
def _points_followed(history):
    """Return the points where the sums are of enough profiles, by what the sums show."""
    followed, shifted, of_one = 0.0, 0.0, 0.0
    for block in range(1, history.shift_px.size - 1):
        if _is_followed(history, block):
            points = history.now.points[block]
            followed += points
            shifted += points if _lost_shift_px(history, block) != 0.0 else 0.0
            of_one += points if _has_one_polarity(history.polarities, block) else 0.0
    return Followed(np.int64(followed), np.int64(shifted), np.int64(of_one))


@kernel(_nrt=False)
def _is_taken(columns, c, seed, half):
    """Return whether the region of interest takes all rows of a column's window."""
    if columns.row_first.size == 0:
        return True
    first = np.int64(columns.row_first[c])
    last = first + np.int64(columns.row_span[c])
    return (seed - half >= first * FRACTION) & (seed + half <= last * FRACTION)


@kernel(_nrt=False)
def _keep_sums(bursts, block, share):
    """Keep a ``share`` of the sums of a block."""
    for polarity in range(2):
        for part in range(2):
            bursts.events[block, polarity, part] *= share
            bursts.rows_px[block, polarity, part] *= share


@kernel(_nrt=False)
def _compare_bursts(columns, half, profiles, blink, common2, bursts, history):
    """Add one column of each block to its sums, and set the shifts in every fourth profile.

    ``profiles`` is the number of those before in the window of events. ``common2`` are the
    variances that the rows of neighbours share, px squared, by column.
    """
    if blink.step == 0:
        return
    shift_px, sets = history.shift_px, profiles % _PROFILES_MIN == 0
    place = (profiles + profiles // _PROFILES_MIN) % BLOCK_COLUMNS
    blocks, products, squares = 0, 0.0, 0.0
    for block in range(1, shift_px.size - 1):
        if history.passing2[block] > _PRODUCT_MIN:
            _keep_sums(bursts, block, 0.0)
            bursts.profiles[block], shift_px[block] = 0, 0.0
            continue
        if bursts.profiles[block] > _PROFILES_MIN and not sets:
            continue
        _keep_sums(bursts, block, _KEPT)
        c = np.uintp((block - 1) * BLOCK_COLUMNS + place)
        shift_px[block] = 0.0
        if c >= columns.seeds.size or columns.seeds[c] < 0 or np.isnan(common2[c]):
            continue
        start, seed = columns.starts[c], columns.seeds[c]
        if not _is_taken(columns, c, seed, half):
            continue
        _add_column(columns.packed, start, seed, half, blink, block, bursts)
        bursts.profiles[block] += 1
        if bursts.profiles[block] < _PROFILES_MIN or not sets:
            continue
        explained_px = history.step_px[block] + _EXPLAINED * np.sqrt(common2[c])
        on = _difference(bursts, block, 1, explained_px)
        off = _difference(bursts, block, 0, explained_px)
        shift_px[block] = np.sign(on) * min(abs(on), abs(off)) if on * off > 0.0 else 0.0
        products += on * off
        squares += (on * off) ** 2
        blocks += 1
    chance = _BY_CHANCE * np.sqrt(squares)
    if sets and products < max(_PRODUCT_MIN * blocks, chance):
        shift_px[:] = 0.0
