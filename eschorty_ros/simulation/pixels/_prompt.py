"""Time at which a signal that starts from rest passes a level, from tables.

From rest photoreceptor and follower move in one direction, ``y = s1 + (s0 - s1) phi(t / tau_p)``
with ``phi(x) = (exp(-x) - rho exp(-x / rho)) / (1 - rho)`` and ``rho = tau_f / tau_p``. A table is
its inverse. A second one gives the gap, in standard deviations of the noise, at which a pixel that
draws a number between 0 and 1 passes, for the pace at which its signal approaches.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.simulation.pixels._passage import GAP_MIN, GAP_STEPS
from eschorty_ros.simulation.pixels._response import OFF, ON, UNKNOWN

_WAY_STEPS, _WAY_MAX = 64, 0.9
"""Entries and end of the table of times: square root of the part of the change done."""
_LAG_STEPS, _LAG_MAX = 32, 0.75
"""The same for the square root of ``rho``."""
_DRAW_STEPS, _PACE_STEPS = 512, 32

# Gaps between which the pace counts: where most pixels pass.
_EARLY, _LATE = 2.5, 0.5


@cache
def way_times() -> NDArray[np.float32]:
    """Return the time after which a signal that started from rest has done a part of its change.

    In time constants of the photoreceptor, shape (_LAG_STEPS + 2, _WAY_STEPS + 2). Rows:
    ``sqrt(tau_f / tau_p)`` from 0 to ``_LAG_MAX``; columns: square root of the part, 0 to
    ``_WAY_MAX``.
    """
    times = np.concatenate(([0.0], np.geomspace(1e-5, 6.0, 4000)))
    parts = (np.arange(_WAY_STEPS + 2) * (_WAY_MAX / _WAY_STEPS)) ** 2
    ways = np.empty((_LAG_STEPS + 2, _WAY_STEPS + 2), dtype=np.float32)
    for k, row in enumerate(ways):
        rho = max((k * _LAG_MAX / _LAG_STEPS) ** 2, 1e-12)
        # 1 - phi without cancellation for short times.
        gone = (rho * np.expm1(-times / rho) - np.expm1(-times)) / (1.0 - rho)
        row[:] = np.sqrt(np.interp(parts, gone, times**2))
    ways.setflags(write=False)
    return ways


def passage_gaps(table: NDArray[np.float64], correlation_us: float) -> NDArray[np.float32]:
    """Return the gap at which a pixel passes whose signal approaches at a steady pace.

    In standard deviations, shape (_PACE_STEPS + 1, _DRAW_STEPS + 1). Rows:
    ``pace / (pace + correlation_us)`` from 0 to 1, the pace in us per standard deviation. Columns:
    the probability not to have passed before, 0 to 1.

    - ``table``: :func:`noise_table` of the same correlation time.
    """
    share = np.arange(_PACE_STEPS + 1) / _PACE_STEPS
    paces_us = correlation_us * share / np.maximum(1.0 - share, 1e-6)
    gap = GAP_MIN + np.arange(len(table)) / GAP_STEPS
    frozen = np.maximum(-np.diff(table[:, 2]), 0.0)
    passed = -np.diff(table[:, 1])
    draws = np.linspace(0.0, 1.0, _DRAW_STEPS + 1)
    gaps = np.empty((_PACE_STEPS + 1, _DRAW_STEPS + 1), dtype=np.float32)
    for row, pace_us in zip(gaps, paces_us, strict=True):
        moved = passed * pace_us
        cost = np.maximum(moved, frozen) + 0.6 * np.minimum(moved, frozen)
        risk = np.append(np.cumsum(cost[::-1])[::-1], 0.0)
        row[:] = np.interp(draws, np.exp(-risk), gap)
    return gaps


@kernel
def _between(table, row, column):
    """Return the value of a table at fractional indices, linear between its entries."""
    whole_row, whole_column = np.int64(row), np.int64(column)
    up, right = row - whole_row, column - whole_column
    i, j = np.uintp(whole_row), np.uintp(whole_column)
    one = np.uintp(1)
    low = table[i, j] + right * (table[i, j + one] - table[i, j])
    high = table[i + one, j] + right * (table[i + one, j + one] - table[i + one, j])
    return low + up * (high - low)


@kernel
def _inside(index, end):
    """Return ``index`` where it is from 0 to below ``end``, else 0."""
    return index if 0.0 <= index < end else 0.0


@kernel
def _gone(u, per_change, level, x):
    """Return the square root of the part of the change to where y is ``exp(x)`` times ``level``."""
    value = level * (1.0 + x * (1.0 + x * (0.5 + x * (1 / 6 + x * (1 / 24)))))
    return math.sqrt((u - value) * per_change)


@kernel
def _prompt(signal, levels, noise, ways, gaps, draw):
    """Return time from now and polarity of the first passage of a signal that leaves rest.

    ``ways`` and ``gaps`` are the tables, ``draw`` a number between 0 and 1. Returns UNKNOWN where
    the tables end, as for levels the signal hardly reaches.
    """
    u, settled, tau_us, follower_us = signal.u, signal.settled, signal.tau_us, signal.follower_us
    falls = settled < u
    level = levels.on if falls else levels.off
    per_gap = noise if falls else -noise
    per_change = 1.0 / (u - settled)
    lag = math.sqrt(follower_us / tau_us) * (_LAG_STEPS / _LAG_MAX)
    scale = _WAY_STEPS / _WAY_MAX
    late = _gone(u, per_change, level, _LATE * per_gap) * scale
    early = _gone(u, per_change, level, _EARLY * per_gap) * scale
    known = early >= 0.0 and late < _WAY_STEPS and lag < _LAG_STEPS
    lag, late, early = (
        _inside(lag, _LAG_STEPS),
        _inside(late, _WAY_STEPS),
        _inside(early, _WAY_STEPS),
    )
    # No branch before the last access to a table: with one, numba counts references to them.
    way_us = (_between(ways, lag, late) - _between(ways, lag, early)) * tau_us
    pace = abs(way_us) / (_EARLY - _LATE)
    share = _inside(pace / (pace + follower_us), 1.0)
    gap = _between(gaps, share * _PACE_STEPS, draw * _DRAW_STEPS)
    gone = _gone(u, per_change, level, gap * per_gap) * scale
    after_us = _between(ways, lag, _inside(gone, _WAY_STEPS)) * tau_us
    if not (known and gone < _WAY_STEPS):
        return np.inf, UNKNOWN
    return after_us, ON if falls else OFF
