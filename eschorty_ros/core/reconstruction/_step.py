"""Compiled correction of points whose footprint straddles a reflectance step."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.kernel import kernel

_REACH = 2


@kernel
def _shift(before, now, after):
    """How far the footprint's centroid moved towards the rows the surface comes from, px.

    Full widths of the lit rows on the surface before the step, across it and behind it. The
    wider side shows ``low / 2 + half`` rows on one side of the centre, the other ``low / 2``.
    As the step crosses, rows of the wider side come first beyond a gap, then replace dark rows,
    then replace lit ones (no change of width), and at last the narrower side's rows go.
    """
    low = min(before, after)
    high = max(before, after)
    extra = min(max(now - low, 0.0), high - low)
    if extra == 0.0:
        size = 0.0
    elif 2.0 * extra <= high - low:
        size = extra * (high - extra) / (2.0 * now)
    else:
        size = 0.5 * (high - low - extra)
    return size if after >= before else -size


@kernel
def _middle(widths, column, lit_only, scratch):
    """Median of the columns around ``column``; with ``lit_only`` of those that have a point."""
    n = 0
    for c in range(max(column - _REACH, 0), min(column + _REACH + 1, widths.size)):
        value = widths[c]
        if value == 0.0 and lit_only:
            continue
        k = n
        while k > 0 and scratch[k - 1] > value:
            scratch[k] = scratch[k - 1]
            k -= 1
        scratch[k] = value
        n += 1
    if n == 0:
        return 0.0
    return 0.5 * (scratch[(n - 1) // 2] + scratch[n // 2])


@kernel
def _middles(widths, scratch, out):
    """Median of the columns around each column, those without a point counting as 0."""
    for c in range(widths.size):
        out[c] = _middle(widths, c, False, scratch)


@kernel
def _between(row_before, row_after, back, ahead):
    """Row on the line between two neighbours in time, or of the only one; NaN without any."""
    if np.isnan(row_before):
        return row_after
    if np.isnan(row_after):
        return row_before
    return (row_before * ahead + row_after * back) / (back + ahead)


@kernel
def _step_shifts(
    column, back, ahead, widths, middles, rows, present, newest, place, sign, width_gate, row_gate,
    scratch, out,
):  # fmt: skip
    """Shift of each point of the profile ``place``, towards the rows the surface comes from.

    ``widths``, their ``middles`` and ``rows`` hold one profile per line, ``place`` and ``newest``
    count profiles without end; ``back`` and ``ahead`` say how many before and after a point's
    footprint is all on one side. Profiles that are not known leave a point as it is, and so does a
    correction that would not bring it nearer to its neighbours; ``sign`` is where the surface
    comes from.
    """
    size = present.size
    now_line = widths[place % size]
    for k in range(column.size):
        out[k] = 0.0
        c = np.int64(column[k])
        first, last = place - back[k], place + ahead[k]
        if first <= newest - size or last > newest:
            continue
        before_slot, after_slot = first % size, last % size
        if not (present[before_slot] and present[after_slot]):
            continue
        before = middles[before_slot, c]
        after = middles[after_slot, c]
        if abs(after - before) < width_gate:
            continue
        row_before, row_after = rows[before_slot, c], rows[after_slot, c]
        if abs(row_before - row_after) > row_gate:
            continue
        now = _middle(now_line, c, True, scratch)
        shift = _shift(before, now, after)
        expected = _between(row_before, row_after, back[k], ahead[k])
        off = rows[place % size, c] - expected
        if not abs(off - sign * shift) > abs(off):
            out[k] = shift
