"""Two lines in the windows of one, such as the laser's and a reflection beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.estimators import HALF_MIN, HALF_PER_SIGMA
from eschorty_ros.core.line.window import FRACTION_BITS, PAD, POLARITY, ROW_MASK

PROFILES_WITH_TWO = 3
"""Successive profiles that show two lines."""
_COLUMNS = 64
# Rows of fewer events are apart by chance too often, and so are those of fewer lines.
_EVENTS_MIN = _LINES_MIN = 8
# A narrow line with a dead row in it has less.
_VARIANCE_MIN = 4.0
# Two evenly lit lines with a gap of a third of their length have this share of their variance on
# either side of the mean: 1 / (1 + 3 (4/3)^2). One evenly lit line has a quarter, a Gaussian more.
_SIDES = 3.0 / 19.0
_OFF, _ON = 1, 2
# That of rows within a pixel.
_PIXEL2 = 1.0 / 12.0


def empty_two_lines() -> NDArray[np.int64]:
    """Return zeroed counts of profiles, one per column that is tested."""
    return np.zeros(_COLUMNS, np.int64)


@kernel(_nrt=False)
def _side_sums(packed, start, seed, half, polarities, parting):
    """Return number, sum and sum of squares of rows up to ``parting`` and beyond.

    Rows are relative to the seed's. Of ``polarities`` bit 0 takes OFF events and bit 1 ON ones.
    """
    middle = seed >> FRACTION_BITS
    low, high = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    i = np.uintp(start)
    while packed[i] != PAD:
        row = np.int64(packed[i] & ROW_MASK)
        taken = polarities >> np.int64((packed[i] & POLARITY) > 0) & 1
        if abs((row << FRACTION_BITS) - seed) <= half and taken:
            d = float(row - middle)
            if d <= parting:
                low = low[0] + 1.0, low[1] + d, low[2] + d * d
            else:
                high = high[0] + 1.0, high[1] + d, high[2] + d * d
        i += np.uintp(1)
    return low, high


@kernel(_nrt=False)
def _scatter_of(sums):
    """Return the sum of squared deviations from the mean."""
    return sums[2] - sums[1] * sums[1] / max(sums[0], 1.0)


@kernel(_nrt=False)
def _are_apart(whole, sides):
    """Return whether rows with these variances are of two lines."""
    return whole > _VARIANCE_MIN and sides < _SIDES * whole


@kernel(_nrt=False)
def _column_sides(packed, start, seed, half, polarities, every, unequal):
    """Return the variance of a column's rows, and that on either side of a row that parts them.

    It is their mean. The mean of ``unequal`` lines is in the stronger one: these are parted in the
    middle of both sides' means. Zeros where there are too few events; ``every`` are their sums.
    """
    if every[0] < _EVENTS_MIN:
        return 0.0, 0.0
    low = high = every
    parting, before = every[1] / every[0], np.inf
    while parting != before and high[0] > 0.0:
        low, high = _side_sums(packed, start, seed, half, polarities, parting)
        middle = 0.5 * (low[1] / low[0] + high[1] / max(high[0], 1.0))
        before = parting
        parting = middle if unequal else parting
    sides = _scatter_of(low) + _scatter_of(high)
    return _scatter_of(every) / every[0] + _PIXEL2, sides / every[0] + _PIXEL2


@kernel(_nrt=False)
def _two_sides(packed, start, seed, half, unequal):
    """Return `_column_sides` of the polarity with more events, and whether there are two lines.

    ON and OFF events of a line that moves while it is lit are apart. Those of one polarity may miss
    in the middle of a line whose pixels give the other one there: both together show no gap then.
    """
    on, _ = _side_sums(packed, start, seed, half, _ON, np.inf)
    off, _ = _side_sums(packed, start, seed, half, _OFF, np.inf)
    more, every = (_ON, on) if on[0] >= off[0] else (_OFF, off)
    whole, sides = _column_sides(packed, start, seed, half, more, every, unequal)
    has_two = _are_apart(whole, sides)
    if has_two:
        every = on[0] + off[0], on[1] + off[1], on[2] + off[2]
        both = _column_sides(packed, start, seed, half, _ON | _OFF, every, unequal)
        has_two = _are_apart(both[0], both[1])
    return whole, sides, has_two


@kernel(_nrt=False)
def _single_half(columns, half, successive, profiles):
    """Return the half width of the window of one line where most columns have two in it, else 0.

    Such windows would give the mean of both lines, and go on to be as wide. A column has two lines
    when three profiles show them, since pixels in the middle of a bright line may answer in every
    second or third period only. ``successive`` has the number so far, one per column tested. Lines
    may be unequal where all ``profiles`` so far had two; later a step that passes has such parts.
    """
    lines, two, total = 0, 0, 0.0
    apart = max(columns.seeds.size // successive.size, 1)
    for k in range(np.uintp(min(successive.size, columns.seeds.size))):
        c = k * np.uintp(apart)
        whole, sides, has_two = 0.0, 0.0, False
        if columns.seeds[c] >= 0:
            whole, sides, has_two = _two_sides(
                columns.packed, columns.starts[c], columns.seeds[c], half, successive[k] == profiles
            )
        lines += whole > 0.0
        successive[k] = successive[k] + 1 if has_two else 0
        if successive[k] >= PROFILES_WITH_TWO:
            two += 1
            total += sides
    if 2 * two <= lines or two < _LINES_MIN:
        return np.int64(0)
    successive[:] = 0
    return np.int64(max(np.rint(HALF_PER_SIGMA * np.sqrt(total / two)), HALF_MIN))
