"""Photoreceptor and source follower in closed form, and when a comparator behind them fires.

Notation: with ``u = exp(-v) = 1 / x`` the photoreceptor under a constant relative photocurrent
``I`` follows ``u(t) = 1/I + (u0 - 1/I) exp(-omega0 I t)``. The follower's pole acts on ``u``, which
differs from acting on ``v`` in second order of the swing and leaves a sum of two exponentials,
``y(t) = 1/I + a exp(-t/tau_p) + b exp(-t/tau_f)``. The comparator's levels are
``y_ref exp(-theta_on)`` (ON: y falls as light rises) and ``y_ref exp(theta_off)``.

Noise at the follower's output is a Gaussian process of correlation time ``tau_f``. It is never
drawn: a pixel whose signal is ``g`` standard deviations from a level passes it at the rate
``r(g)``, and while the gap shrinks from ``g1`` to ``g2`` also with the probability that the noise
at hand reaches across; both come from a table (``_noise_table``). The event is where the rates
summed up reach an exponential number drawn once per pixel and piece of signal.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

# An exponential this far gone is below half a unit in the last place of what it is added to.
_SETTLED = 38.0

GAP_MIN, GAP_MAX, GAP_STEPS = -4.0, 4.5, 64.0
"""Span of the noise table in standard deviations, and its entries per standard deviation."""

ON, OFF, NOTHING, UNKNOWN = 1, 0, -1, -2

# Columns of the noise table: passages per us, their sum over the gaps above, and minus the log
# of the share of noise below the gap.
_RATE, _SUM, _SHARE = 0, 1, 2
_BEND = 0.15
"""Largest bend of the gap's path within a step of the summation, standard deviations."""
_STEPS_MAX = 4096


@njit(cache=True, nogil=True, error_model="numpy")
def _shares(u, y, settled, tau_us, follower_us):
    """``a`` and ``b`` of the follower's two exponentials, and the time constant of ``b``."""
    apart = 1.0 - follower_us / tau_us
    # Equal time constants have no such form; a part in a million apart they have, to 1e-6.
    if abs(apart) < 1e-6:
        apart, follower_us = 1e-6, tau_us * (1.0 - 1e-6)
    a = (u - settled) / apart
    return a, y - settled - a, follower_us


@njit(cache=True, nogil=True, error_model="numpy")
def _advanced(u, y, settled, tau_us, follower_us, t_us):
    """Photoreceptor and follower after ``t_us`` of constant light."""
    x, z = t_us / tau_us, t_us / follower_us
    if x > _SETTLED and z > _SETTLED:
        return settled, settled
    way = u - settled
    fade = math.exp(-x) if x < _SETTLED else 0.0
    lag = math.exp(-z) if z < _SETTLED else 0.0
    apart = 1.0 - follower_us / tau_us
    w = x * apart * (tau_us / follower_us)
    if abs(w) > 0.1:
        share = (fade - lag) / apart
    else:
        # expm1(w) / w: both exponentials fall nearly or wholly into one.
        share = lag * (t_us / follower_us) * (math.expm1(w) / w if w != 0.0 else 1.0)
    if x < 0.01 and z < 0.01:
        return u + way * math.expm1(-x), y + (y - settled) * math.expm1(-z) + way * share
    return settled + way * fade, settled + (y - settled) * lag + way * share


@njit(cache=True, nogil=True, error_model="numpy")
def _fade(x):
    """``exp(-x)`` to 2e-6: enough where risks are summed up, and quicker."""
    if not -0.5 < x < 0.5:
        return math.exp(-x)
    x = -x
    return 1.0 + x * (
        1.0
        + x * (0.5 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x / 720))))
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(settled, a, b, tau_us, follower_us, level, lo_us, hi_us):
    """Time in [lo, hi] at which the monotone y passes ``level``: Newton kept inside a bracket."""
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


@njit(cache=True, nogil=True, error_model="numpy")
def _noiseless(u, y, settled, tau_us, follower_us, on_level, off_level):
    """Time from now and polarity of the first passage of y; NOTHING when there is none."""
    if y <= on_level:
        return 0.0, ON
    if y >= off_level:
        return 0.0, OFF
    a, b, follower_us = _shares(u, y, settled, tau_us, follower_us)
    begin_us = 0.0
    # y turns round at most once, soon after the light has changed.
    if a * b < 0.0:
        share = -b * tau_us / (a * follower_us)
        turn_us = math.log(share) / (1.0 / follower_us - 1.0 / tau_us)
        if turn_us > 0.0:
            at_turn = (
                settled + a * math.exp(-turn_us / tau_us) + b * math.exp(-turn_us / follower_us)
            )
            if at_turn <= on_level:
                return _solve(settled, a, b, tau_us, follower_us, on_level, 0.0, turn_us), ON
            if at_turn >= off_level:
                return _solve(settled, a, b, tau_us, follower_us, off_level, 0.0, turn_us), OFF
            begin_us = turn_us
    end_us = begin_us + 60.0 * (tau_us + follower_us)
    if settled < on_level:
        return _solve(settled, a, b, tau_us, follower_us, on_level, begin_us, end_us), ON
    if settled > off_level:
        return _solve(settled, a, b, tau_us, follower_us, off_level, begin_us, end_us), OFF
    return np.inf, NOTHING


@njit(cache=True, nogil=True, error_model="numpy")
def _earliest_us(u, y, settled, t_us, tau_us, follower_us, on_level, off_level, reach):
    """A time before which nothing can happen: where y comes within ``reach`` of a level.

    ``inf`` when no level is near. ``reach`` is the largest gap the noise table knows, as a factor.
    """
    on_near, off_near = on_level * reach, off_level / reach
    if min(u, y) <= on_near or max(u, y) >= off_near:
        return t_us
    if settled < on_near:
        near = on_near
    elif settled > off_near:
        near = off_near
    else:
        return np.inf
    # The response to a ramp as steep as u is now: u itself moves less and y lags behind it. With
    # y ahead of u only the former holds.
    ramp_us = tau_us * (u - near) / (u - settled)
    lags = (y - u) * (u - settled) >= -1e-6 * u * abs(u - settled)
    return t_us + (max(ramp_us, math.sqrt(2.0 * follower_us * ramp_us)) if lags else 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _entry(gap):
    """Row of the noise table for a gap."""
    # By way of a signed integer: converting to an unsigned one is slow.
    return np.uintp(np.int64((min(max(gap, GAP_MIN), GAP_MAX) - GAP_MIN) * GAP_STEPS))


@njit(cache=True, nogil=True, error_model="numpy")
def _cost(old, new, per_gap_us, step_us, table):
    """Risk spent while the gap went from entry ``old`` to ``new`` at a steady pace."""
    frozen = max(0.0, table[new, _SHARE] - table[old, _SHARE])
    moved = (table[new, _SUM] - table[old, _SUM]) * per_gap_us
    passed = table[new, _RATE] * step_us if old == new else moved
    return max(passed, frozen) + 0.6 * min(passed, frozen)


@njit(cache=True, nogil=True, error_model="numpy")
def _part(old, new, spent, table):
    """Part of a step in which ``spent`` of its risk was spent, the rate growing evenly."""
    first, last = table[old, _RATE] + 1e-300, table[new, _RATE] + 1e-300
    root = math.sqrt(first * first + spent * (last * last - first * first))
    return spent * (first + last) / (first + root)


@njit(cache=True, nogil=True, error_model="numpy")
def _gap(value, per_level, noise, per_noise, sign):
    """Distance of y from a level in standard deviations, positive inside the band.

    ``log(1 + x) / noise`` by its series: near the level it counts, far off it only has to rise.
    """
    x = sign * (value * per_level - 1.0)
    return x * (1.0 + x * (x * (1 / 3) - sign * 0.5)) * per_noise


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _noisy(
    u, y, settled, tau_us, follower_us, on_level, off_level, middle, noise, table, from_us,
    until_us, budget,
):  # fmt: skip
    """Time from now and polarity of the first passage of y with noise.

    Sums up the risk from ``from_us`` on until it reaches ``budget``, in steps over which the gaps
    change at a nearly steady pace. A moving signal risks to pass the nearer level only, on its
    side of ``middle``. Returns UNKNOWN when nothing happened up to ``until_us`` and the signal
    still moves: ask again later. The steps do not depend on ``until_us``.
    """
    a, b, follower_us = _shares(u, y, settled, tau_us, follower_us)
    rate_a, rate_b = 1.0 / tau_us, 1.0 / follower_us
    if from_us > 0.0:
        a *= _fade(from_us * rate_a)
        b *= _fade(from_us * rate_b)
    per_noise, per_on, per_off = 1.0 / noise, 1.0 / on_level, 1.0 / off_level
    value = settled + a + b
    bend_a, bend_b = rate_a * rate_a, rate_b * rate_b
    # A step h bends the path of the gap by h^2/8 times its second derivative.
    bend = abs(a) * bend_a + abs(b) * bend_b
    step_us = min(math.sqrt(8.0 * _BEND * value * noise / (bend + 1e-300)), 0.5 * tau_us)
    fade_a, fade_b = _fade(step_us * rate_a), _fade(step_us * rate_b)
    t, spent = from_us, 0.0
    old_sign, old_gap, old = 0.0, 0.0, np.uintp(0)
    for _ in range(_STEPS_MAX):
        sign = 1.0 if value < middle else -1.0
        per_level = per_on if value < middle else per_off
        gap = _gap(value, per_level, noise, per_noise, sign)
        entry = _entry(gap)
        if old_sign != 0.0:
            if sign != old_sign:
                old_gap = GAP_MAX + 1.0
                old = _entry(old_gap)
            pace = step_us / (old_gap - gap)
            cost = _cost(old, entry, pace, step_us, table)
            if spent + cost >= budget:
                part = _part(old, entry, (budget - spent) / cost, table)
                return t - step_us * (1.0 - part), ON if sign > 0.0 else OFF
            spent += cost
        scale = value * noise
        if abs(a) + abs(b) < 0.05 * scale:
            per_other = per_off if value < middle else per_on
            other = _entry(_gap(value, per_other, noise, per_noise, -sign))
            rate = table[entry, _RATE] + table[other, _RATE]
            if rate == 0.0:
                return np.inf, NOTHING
            return t + (budget - spent) / rate, ON if sign > 0.0 else OFF
        if t > until_us:
            return np.inf, UNKNOWN
        longer = (abs(a) * bend_a + abs(b) * bend_b) * step_us * step_us < 2.0 * _BEND * scale
        step_us = 2.0 * step_us if longer else step_us
        fade_a = fade_a * fade_a if longer else fade_a
        fade_b = fade_b * fade_b if longer else fade_b
        old_sign, old_gap, old = sign, gap, entry
        a *= fade_a
        b *= fade_b
        value = settled + a + b
        t += step_us
    return np.inf, UNKNOWN
