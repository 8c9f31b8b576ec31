"""When a signal that sets out from rest passes a level: looked up, not summed.

From rest photoreceptor and follower go one way, ``y = s1 + (s0 - s1) phi(t / tau_p)`` with
``phi(x) = (exp(-x) - rho exp(-x / rho)) / (1 - rho)`` and ``rho = tau_f / tau_p``. A table holds
its inverse. A second one holds the gap, in standard deviations of the noise, at which a pixel
passes that draws a number between 0 and 1, for the pace at which its signal comes near.
"""

from __future__ import annotations

import math

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.simulation.pixels._response import OFF, ON, UNKNOWN

WAY_STEPS, WAY_MAX = 64, 0.9
"""Entries and end of the table of times: square root of the part of the way gone."""
LAG_STEPS, LAG_MAX = 32, 0.75
"""The same for the square root of ``rho``."""
DRAW_STEPS, PACE_STEPS = 512, 32

# Gaps between which the pace counts: where most pixels pass.
_EARLY, _LATE = 2.5, 0.5


@kernel
def _between(table, row, column):
    """Value of a table at fractional indices, linear between its entries."""
    whole_row, whole_column = np.int64(row), np.int64(column)
    up, right = row - whole_row, column - whole_column
    i, j = np.uintp(whole_row), np.uintp(whole_column)
    one = np.uintp(1)
    low = table[i, j] + right * (table[i, j + one] - table[i, j])
    high = table[i + one, j] + right * (table[i + one, j + one] - table[i + one, j])
    return low + up * (high - low)


@kernel
def _inside(index, end):
    """``index`` where it lies from 0 to below ``end``, else 0."""
    return index if 0.0 <= index < end else 0.0


@kernel
def _gone(u, per_way, level, x):
    """Square root of the part of the way to where y is ``exp(x)`` times ``level``."""
    value = level * (1.0 + x * (1.0 + x * (0.5 + x * (1 / 6 + x * (1 / 24)))))
    return math.sqrt((u - value) * per_way)


@kernel
def _prompt(u, settled, tau_us, follower_us, on_level, off_level, noise, ways, gaps, draw):
    """Time from now and polarity of the first passage of a signal at rest that moves away.

    ``ways`` and ``gaps`` are the tables, ``draw`` a number between 0 and 1. Returns UNKNOWN where
    the tables end, as for levels the signal hardly reaches.
    """
    falls = settled < u
    level = on_level if falls else off_level
    per_gap = noise if falls else -noise
    per_way = 1.0 / (u - settled)
    lag = math.sqrt(follower_us / tau_us) * (LAG_STEPS / LAG_MAX)
    scale = WAY_STEPS / WAY_MAX
    late = _gone(u, per_way, level, _LATE * per_gap) * scale
    early = _gone(u, per_way, level, _EARLY * per_gap) * scale
    known = early >= 0.0 and late < WAY_STEPS and lag < LAG_STEPS
    lag, late, early = _inside(lag, LAG_STEPS), _inside(late, WAY_STEPS), _inside(early, WAY_STEPS)
    # No branch up to the last look at a table: with one, numba counts references to them.
    way_us = (_between(ways, lag, late) - _between(ways, lag, early)) * tau_us
    pace = abs(way_us) / (_EARLY - _LATE)
    share = _inside(pace / (pace + follower_us), 1.0)
    gap = _between(gaps, share * PACE_STEPS, draw * DRAW_STEPS)
    gone = _gone(u, per_way, level, gap * per_gap) * scale
    after_us = _between(ways, lag, _inside(gone, WAY_STEPS)) * tau_us
    if not (known and gone < WAY_STEPS):
        return np.inf, UNKNOWN
    return after_us, ON if falls else OFF
