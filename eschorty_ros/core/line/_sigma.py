"""Compiled error model of a row: how far the estimate of a column is off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.line._window import FRACTION

# A line that jumps further lies on another surface: its last place says nothing any more.
_MOTION_MAX_PX = 8.0
# Standard deviation over the way of a line that jumps.
_JUMP = 0.2
# Scatter of the full width of an unclipped footprint, rows.
_WIDTH_SCATTER_PX = 0.7


class Noise(NamedTuple):
    """Coefficients of an estimator's error model, see `row_sigma`."""

    factor: float
    floor: float
    common: float
    motion: float
    background: float
    clipped: float
    median: bool


@kernel
def _excess_events(excess, count, row, rows):
    """Return number of background events, evenly spread over the rows, behind ``excess`` variance.

    Returns also the share of their mean square distance that they have in common, as most lie on
    one side of a line away from the middle.
    """
    offset = 0.5 * (rows - 1.0) - row
    square = rows * rows / 12.0 + offset * offset
    return excess * count / square, offset * offset / square


@kernel
def _sigma2(variance, own, count, row, rows, noise):
    """Variance of one column's row, px squared, without what its neighbours share.

    ``own`` is the variance the line itself has. What a column has beyond it comes from events
    that do not repeat from pixel to pixel and scatter independently. Rows quantise to a twelfth
    when there is no spread to judge by.
    """
    floor2 = noise.floor**2
    sigma2 = noise.factor**2 * min(variance, own) / count + floor2
    excess = variance - own
    if excess > 0.0:
        strays, shared = _excess_events(excess, count, row, rows)
        coherent = 1.0 + max(strays - 1.0, 0.0) * shared
        if noise.median:
            # A stray event moves the median by half the distance of two of the line's events.
            step2 = 3.0 * own / (count * count)
            sigma2 += noise.background**2 * strays * coherent * step2
        else:
            sigma2 += noise.background**2 * excess / count * coherent
    if count < 2 or variance == 0.0:
        sigma2 = max(sigma2, 1.0 / 12.0 + floor2)
    return sigma2


@kernel
def _common2(centre, last, noise):
    """Variance that neighbouring columns share, from the line's way since the last profile.

    ``centre`` and ``last`` are in fixed point, ``last`` negative when there was none. Pixels
    remember where the line was: on a surface that recedes, points lag behind.
    """
    moved = 0.0
    if last >= 0:
        moved = min(abs(centre - last) / FRACTION, _MOTION_MAX_PX)
    return noise.common**2 + noise.motion**2 * moved + (_JUMP * moved) ** 2


@kernel
def _clipped2(variance, own, noise):
    """Variance of a row whose footprint is narrower than the line.

    An edge of range or reflectance within the line's thickness leaves only a part of it, and the
    middle of that part lies off the line by up to half of what is missing.
    """
    missing = np.sqrt(12.0) * (np.sqrt(own) - np.sqrt(variance)) - _WIDTH_SCATTER_PX
    return (noise.clipped * max(missing, 0.0)) ** 2
