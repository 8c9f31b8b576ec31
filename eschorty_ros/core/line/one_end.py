"""Lines that lose one end in the readout: it stays in the same rows, the other is the surface's.

A readout that takes the rows in their order, and loses the later ones while a burst lasts, ends
all lines at about the same row. Other ends are as far apart as the rows of the surface are. The
end that follows the surface shows the row, as the widest lines show how far that is from it.
"""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.line_history import PER_WIDTH

# Least variance of the rows, px squared: ends are whole rows.
_ROW2_MIN = 1.0
# Variance of an end over that of the rows: 0 where it stays, 1 where it follows the surface.
_STAYS = 0.5


@kernel(_nrt=False)
def _variance(now, widths):
    """Return the variance over the blocks of the rows, so many ``widths`` further."""
    points, total, squares = 0.0, 0.0, 0.0
    for block in range(1, now.points.size - 1):
        if now.points[block] > 0.0:
            value = now.row[block] + widths * now.width[block]
            points += now.points[block]
            total += value
            squares += value * value / now.points[block]
    mean = total / max(points, 1.0)
    return squares / max(points, 1.0) - mean * mean


@kernel(_nrt=False)
def _end_that_stays(now):
    """Return which end of a profile's lines is in the same rows: 1 the last, -1 the first.

    The other end follows the surface. 0 where it is not so.
    """
    row2, first2, last2 = _variance(now, 0.0), _variance(now, -PER_WIDTH), _variance(now, PER_WIDTH)
    if not (row2 > _ROW2_MIN and min(first2, last2) < _STAYS * row2):
        return 0
    return 1 if last2 < first2 else -1


@kernel(_nrt=False)
def _restore_ends(rows, smoothing, now, end):
    """Move rows by half of what their lines have lost at an ``end``, and mark the points.

    Lines have lost what the widest of the profile has more than they. That is the uncertainty, too,
    as it may have lost rows itself.
    """
    widest_px = 0.0
    for block in range(1, now.points.size - 1):
        widest_px = max(widest_px, now.width[block] / max(now.points[block], 1.0))
    returns, columns = rows.row.shape
    for k in range(returns):
        for c in range(np.uintp(columns)):
            rows.mixed[k, c] = True
            lost_px = PER_WIDTH * (widest_px - smoothing.width[k, c])
            # A point without a width has none.
            if lost_px > 0.0:
                smoothing.row[k, c] += end * lost_px
                smoothing.sigma2[k, c] += lost_px * lost_px
