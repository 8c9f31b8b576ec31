"""Photoreceptor and source follower in closed form, and the comparator behind them.

Notation: with ``u = exp(-v) = 1 / x`` the photoreceptor under a constant relative photocurrent
``I`` follows ``u(t) = 1/I + (u0 - 1/I) exp(-omega0 I t)``. The follower's pole acts on ``u``, which
differs from acting on ``v`` in second order of the swing and leaves a sum of two exponentials,
``y(t) = 1/I + a exp(-t/tau_p) + b exp(-t/tau_f)``. The comparator's levels are
``y_ref exp(-theta_on)`` (ON: y falls as light rises) and ``y_ref exp(theta_off)``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel

# After this many time constants an exponential is below half a unit in the last place of the sum.
_SETTLED = 38.0

ON, OFF, NOTHING, UNKNOWN = 1, 0, -1, -2


class Signal(NamedTuple):
    """Photoreceptor and follower of a pixel now, their final value and time constants."""

    u: float
    y: float
    settled: float
    tau_us: float
    follower_us: float


class Levels(NamedTuple):
    """Values of y at which the comparator fires."""

    on: float
    off: float


class _Shares(NamedTuple):
    """The follower's two exponentials: ``a`` and ``b``, and the time constant of ``b``."""

    a: float
    b: float
    follower_us: float


@kernel
def _shares(signal):
    """Return the follower's two exponentials."""
    u, y, settled, tau_us, follower_us = signal
    apart = 1.0 - follower_us / tau_us
    # Equal time constants have no such form; a difference of a part in a million suffices.
    if abs(apart) < 1e-6:
        apart, follower_us = 1e-6, tau_us * (1.0 - 1e-6)
    a = (u - settled) / apart
    return _Shares(a, y - settled - a, follower_us)


@kernel
def _advanced(signal, t_us):
    """Return photoreceptor and follower after ``t_us`` of constant light."""
    u, y, settled, tau_us, follower_us = signal
    if t_us > _SETTLED * tau_us and t_us > _SETTLED * follower_us:
        return settled, settled
    x, z = t_us / tau_us, t_us / follower_us
    change = u - settled
    fade = math.exp(-x) if x < _SETTLED else 0.0
    lag = math.exp(-z) if z < _SETTLED else 0.0
    apart = 1.0 - follower_us / tau_us
    w = x * apart * (tau_us / follower_us)
    if abs(w) > 0.1:
        share = (fade - lag) / apart
    else:
        # expm1(w) / w: the two exponentials are nearly or exactly one.
        share = lag * (t_us / follower_us) * (math.expm1(w) / w if w != 0.0 else 1.0)
    if x < 0.01 and z < 0.01:
        return u + change * math.expm1(-x), y + (y - settled) * math.expm1(-z) + change * share
    return settled + change * fade, settled + (y - settled) * lag + change * share


@kernel
def _fade(x):
    """Return ``exp(-x)`` to 2e-6, faster."""
    if not -0.5 < x < 0.5:
        return math.exp(-x)
    x = -x
    return 1.0 + x * (
        1.0
        + x * (0.5 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x / 720))))
    )  # fmt: skip


@kernel
def _solve(settled, a, b, tau_us, follower_us, level, lo_us, hi_us):
    """Return the time in [lo, hi] at which the monotone y passes ``level``.

    Newton's steps, kept inside a bracket.
    """
    sign = 1.0 if settled + a * math.exp(-lo_us / tau_us) + b * math.exp(
        -lo_us / follower_us
    ) > level else -1.0  # fmt: skip
    t = lo_us
    for _ in range(200):
        ep, ef = a * math.exp(-t / tau_us), b * math.exp(-t / follower_us)
        off = settled + ep + ef - level
        if sign * off > 0.0:
            lo_us = t
        else:
            hi_us = t
        slope = -ep / tau_us - ef / follower_us
        new = t - off / slope if slope != 0.0 else np.inf
        if not lo_us < new < hi_us:
            new = 0.5 * (lo_us + hi_us)
        if abs(new - t) <= 1e-13 * new:
            return new
        t = new
    return t


@kernel
def _noiseless(signal, levels):
    """Return time from now and polarity of the first passage of y; NOTHING when there is none."""
    settled, tau_us = signal.settled, signal.tau_us
    if signal.y <= levels.on:
        return 0.0, ON
    if signal.y >= levels.off:
        return 0.0, OFF
    a, b, follower_us = _shares(signal)
    begin_us = 0.0
    # y turns round at most once, soon after the light has changed.
    if a * b < 0.0:
        share = -b * tau_us / (a * follower_us)
        turn_us = math.log(share) / (1.0 / follower_us - 1.0 / tau_us)
        if turn_us > 0.0:
            at_turn = (
                settled + a * math.exp(-turn_us / tau_us) + b * math.exp(-turn_us / follower_us)
            )
            if at_turn <= levels.on:
                return _solve(settled, a, b, tau_us, follower_us, levels.on, 0.0, turn_us), ON
            if at_turn >= levels.off:
                return _solve(settled, a, b, tau_us, follower_us, levels.off, 0.0, turn_us), OFF
            begin_us = turn_us
    end_us = begin_us + 60.0 * (tau_us + follower_us)
    if settled < levels.on:
        return _solve(settled, a, b, tau_us, follower_us, levels.on, begin_us, end_us), ON
    if settled > levels.off:
        return _solve(settled, a, b, tau_us, follower_us, levels.off, begin_us, end_us), OFF
    return np.inf, NOTHING


@kernel
def _earliest_us(signal, t_us, levels, reach):
    """Return a time before which no event is possible: y comes within ``reach`` of a level.

    ``inf`` when no level is near. ``reach`` is the largest gap of the noise table, as a factor.
    """
    u, y, settled, tau_us, follower_us = signal
    on_near, off_near = levels.on * reach, levels.off / reach
    if min(u, y) <= on_near or max(u, y) >= off_near:
        return t_us
    # Where y is ahead of u its lead only decays, so that the signal may start from y.
    if settled < on_near:
        margin = min(u, y) - on_near
    elif settled > off_near:
        margin = max(u, y) - off_near
    else:
        return np.inf
    # Far ahead it is about to turn round; the risk of that is summed up from the start.
    ahead_max = u * max(0.02 * (reach - 1.0), 1e-6)
    if (y - u) * (u - settled) < -ahead_max * abs(u - settled):
        return t_us
    # The response to a ramp as steep as u is now: u itself moves less and y lags behind it.
    ramp_us = tau_us * margin / (u - settled)
    return t_us + max(ramp_us, math.sqrt(2.0 * follower_us * ramp_us))
