"""Whether one end of the line stays in the same rows while the other follows the surface.

A readout that takes the rows in their order, and loses the later ones while a burst lasts, ends
all lines at about the same row. Other ends are as far apart as the rows of the surface are.
"""

from __future__ import annotations

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
def _one_end_stays(now):
    """Return whether the lines of a profile have one end in the same rows, and not the other."""
    row2 = _variance(now, 0.0)
    end2 = min(_variance(now, PER_WIDTH), _variance(now, -PER_WIDTH))
    return row2 > _ROW2_MIN and end2 < _STAYS * row2
