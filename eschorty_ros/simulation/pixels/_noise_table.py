"""How soon Gaussian noise of a given correlation time reaches across a gap."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.simulation.pixels._passage import GAP_MAX, GAP_MIN, GAP_STEPS
from eschorty_ros.simulation.pixels._prompt import (
    DRAW_STEPS,
    LAG_MAX,
    LAG_STEPS,
    PACE_STEPS,
    WAY_MAX,
    WAY_STEPS,
)

DECISION_US = 1.0
"""The comparator decides once in so long: it does not see what noise does in between."""


@cache
def noise_table(correlation_us: float) -> NDArray[np.float64]:
    """Risk of a passage against the gap between signal and level.

    The noise is an Ornstein-Uhlenbeck process looked at every ``DECISION_US``. Its rate of
    first passages out of equilibrium is one over the mean first-passage time
    ``sqrt(2 pi) integral_0^g exp(z^2/2) Phi(z) dz`` (in correlation times); discrete looks act
    like a level higher by ``0.5826 sqrt(2 dt / tau)`` (Siegmund's correction). Below a gap of 1
    the rate joins on to ``1 - g``, exact at 0 and -1 (zeros of the Hermite polynomials).

    Parameters
    ----------
    correlation_us : float
        Time constant of the noise, positive.

    Returns
    -------
    ndarray of float64, shape (n, 3)
        Per gap from ``GAP_MIN`` to ``GAP_MAX`` in steps of ``1 / GAP_STEPS``: passages per us,
        their integral from the gap to ``GAP_MAX``, and minus the log of the probability that
        the noise is below the gap.
    """
    gap = GAP_MIN + np.arange(round((GAP_MAX - GAP_MIN) * GAP_STEPS) + 1) / GAP_STEPS
    shifted = gap + 0.5826 * math.sqrt(2.0 * DECISION_US / correlation_us)
    fine = np.linspace(0.0, 12.0, 12_001)
    below = np.array([0.5 * math.erfc(-z / math.sqrt(2.0)) for z in fine])
    integrand = math.sqrt(2.0 * math.pi) * np.exp(0.5 * fine**2) * below
    passage = np.concatenate(
        ([0.0], np.cumsum(0.5 * (integrand[1:] + integrand[:-1]) * np.diff(fine)))
    )
    at_one = 1.0 / float(np.interp(1.0, fine, passage))
    rate = np.where(
        shifted > 1.0,
        1.0 / np.interp(np.maximum(shifted, 1.0), fine, passage),
        np.where(shifted > 0.0, at_one ** np.clip(shifted, 0.0, 1.0), 1.0 - shifted),
    )
    share = np.array([-math.log(0.5 * math.erfc(-g / math.sqrt(2.0))) for g in gap])
    rate[-1] = 0.0
    share[-1] = 0.0
    rate /= correlation_us
    above = np.concatenate((np.cumsum((0.5 * (rate[1:] + rate[:-1]))[::-1])[::-1], [0.0]))
    table = np.ascontiguousarray(np.column_stack((rate, above / GAP_STEPS, share)))
    table.setflags(write=False)
    return table


def passage_gaps(table: NDArray[np.float64], correlation_us: float) -> NDArray[np.float32]:
    """Gap at which a pixel passes whose signal comes near at a steady pace.

    Parameters
    ----------
    table : ndarray of float64, shape (n, 3)
        What :func:`noise_table` gave for the same correlation time.
    correlation_us : float

    Returns
    -------
    ndarray of float32, shape (PACE_STEPS + 1, DRAW_STEPS + 1)
        Standard deviations. Rows: ``pace / (pace + correlation_us)`` from 0 to 1, the pace in us
        per standard deviation. Columns: the probability not to have passed before, 0 to 1.
    """
    share = np.arange(PACE_STEPS + 1) / PACE_STEPS
    paces_us = correlation_us * share / np.maximum(1.0 - share, 1e-6)
    gap = GAP_MIN + np.arange(len(table)) / GAP_STEPS
    frozen = np.maximum(-np.diff(table[:, 2]), 0.0)
    passed = -np.diff(table[:, 1])
    draws = np.linspace(0.0, 1.0, DRAW_STEPS + 1)
    gaps = np.empty((PACE_STEPS + 1, DRAW_STEPS + 1), dtype=np.float32)
    for row, pace_us in zip(gaps, paces_us, strict=True):
        moved = passed * pace_us
        cost = np.maximum(moved, frozen) + 0.6 * np.minimum(moved, frozen)
        risk = np.append(np.cumsum(cost[::-1])[::-1], 0.0)
        row[:] = np.interp(draws, np.exp(-risk), gap)
    return gaps


@cache
def way_times() -> NDArray[np.float32]:
    """Time after which a signal that set out from rest has gone a part of its way.

    Returns
    -------
    ndarray of float32, shape (LAG_STEPS + 2, WAY_STEPS + 2)
        In time constants of the photoreceptor. Rows: ``sqrt(tau_f / tau_p)`` from 0 to
        ``LAG_MAX``; columns: square root of the part, 0 to ``WAY_MAX``.
    """
    times = np.concatenate(([0.0], np.geomspace(1e-5, 6.0, 4000)))
    wanted = (np.arange(WAY_STEPS + 2) * (WAY_MAX / WAY_STEPS)) ** 2
    ways = np.empty((LAG_STEPS + 2, WAY_STEPS + 2), dtype=np.float32)
    for k, row in enumerate(ways):
        rho = max((k * LAG_MAX / LAG_STEPS) ** 2, 1e-12)
        # 1 - phi without cancellation for short times.
        gone = (rho * np.expm1(-times / rho) - np.expm1(-times)) / (1.0 - rho)
        row[:] = np.sqrt(np.interp(wanted, gone, times**2))
    ways.setflags(write=False)
    return ways
