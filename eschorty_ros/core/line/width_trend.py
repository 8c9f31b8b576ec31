"""Lines whose width changes evenly for longer than an edge takes to cross them.

The light has a thickness, so the line on a surface that slopes along the sweep is narrower or
wider than on one that faces it, and its width changes where the surface curves. An edge changes it,
too, but only while the stage moves by the thickness of the light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line.line_history import STEADY
from eschorty_ros.core.line.reflectance import ROOT_12

# Two more than determine a straight line.
_PROFILES_MIN = 4.0


class WidthTrend(NamedTuple):
    """A straight line through recent widths of each column: its end, px, and change per profile.

    The widths of so many ``profiles`` are on it. They change evenly (``even``) where an edge takes
    no longer: ``crossing`` has by row the profiles in which one crosses a px of the line's width, 0
    where this is not known.
    """

    width: NDArray[np.float64]
    change: NDArray[np.float64]
    profiles: NDArray[np.float64]
    even: NDArray[np.bool_]
    crossing: NDArray[np.float64]


def empty_trend(columns: int, rows: int) -> WidthTrend:
    """Return no trend."""
    width, change, profiles = np.zeros((3, columns))
    return WidthTrend(width, change, profiles, np.zeros(columns, dtype=np.bool_), np.zeros(rows))


@kernel(_nrt=False)
def _follow_widths(row, last_row, width, sigma, trend):
    """Continue the trend with the ``width`` of each column, px, whose deviation is ``sigma``.

    Where a width is off the trend half of the profiles count from then on.
    """
    last = np.int64(trend.crossing.size - 1)
    for c in range(np.uintp(row.size)):
        trend.even[c] = False
        if np.isnan(row[c]):
            continue
        crossing = trend.crossing[min(max(np.int64(row[c]), 0), last)]
        if crossing == 0.0:
            continue
        if not abs(row[c] - last_row[c]) < width[c]:
            # Another surface, or none before.
            trend.profiles[c], trend.width[c], trend.change[c] = 0.0, width[c], 0.0
        profiles, end = trend.profiles[c] + 1.0, trend.width[c] + trend.change[c]
        off = width[c] - end
        needed = max(ROOT_12 * width[c] * crossing, _PROFILES_MIN)
        profiles = min(profiles, needed)
        # The end of a line through n points has 4 / n of their variance.
        if profiles > 2.0 and off * off > STEADY**2 * sigma * sigma * (1.0 + 4.0 / profiles):
            profiles *= 0.5
        # Gains of least squares over that many profiles.
        pairs = profiles * (profiles + 1.0)
        trend.width[c] = end + min((4.0 * profiles - 2.0) / pairs, 1.0) * off
        trend.change[c] += min(6.0 / pairs, 1.0) * off
        trend.profiles[c], trend.even[c] = profiles, profiles == needed
