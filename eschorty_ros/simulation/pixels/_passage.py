"""Early firing of a comparator because of noise.

Noise at the follower's output is a Gaussian process of correlation time ``tau_f``. It is never
drawn: a pixel whose signal is ``g`` standard deviations from a level passes it at the rate
``r(g)``, and while the gap shrinks from ``g1`` to ``g2`` also with the probability that the present
noise reaches across; both come from a table (``noise_table``). The event is at the time when the
integrated rate reaches an exponential number drawn once per pixel and piece of signal.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.simulation.pixels._response import NOTHING, OFF, ON, UNKNOWN, _shares

DECISION_US = 1.0
"""Interval of the comparator's decisions, us; noise in between has no effect."""

GAP_MIN, GAP_MAX, GAP_STEPS = -4.0, 4.5, 64.0
"""Span of the noise table in standard deviations, and its entries per standard deviation."""

# Columns of the noise table: passages per us, their sum over the gaps above, and minus the log
# of the share of noise below the gap.
_RATE, _SUM, _SHARE = 0, 1, 2
_BEND = 0.15
"""Largest bend of the gap's path within a step of the summation, standard deviations."""
_STEPS_MAX = 4096

_DECAY_STEPS, _DECAY_MAX = 32.0, 40.0
_DECAY = np.exp(-np.arange(int(_DECAY_STEPS * _DECAY_MAX) + 1) / _DECAY_STEPS)


@cache
def noise_table(correlation_us: float) -> NDArray[np.float64]:
    """Return the risk of a passage against the gap between signal and level, shape (n, 3).

    Rows: the gap from ``GAP_MIN`` to ``GAP_MAX`` in steps of ``1 / GAP_STEPS``. Columns: passages
    per us, their integral from the gap to ``GAP_MAX``, and minus the log of the probability that
    the noise is below the gap.

    The noise is an Ornstein-Uhlenbeck process of time constant ``correlation_us`` (positive),
    sampled every ``DECISION_US``. Its rate of first passages out of equilibrium is one over the
    mean first-passage time ``sqrt(2 pi) integral_0^g exp(z^2/2) Phi(z) dz`` (in correlation times);
    discrete samples act like a level higher by ``0.5826 sqrt(2 dt / tau)`` (Siegmund's correction).
    Below a gap of 1 the rate joins on to ``1 - g``, exact at 0 and -1 (zeros of the Hermite
    polynomials).
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


@kernel
def _decay(x):
    """Return ``exp(-x)`` of a positive number to 1e-6: faster, and enough for a sum of risks."""
    x = min(x, _DECAY_MAX)
    entry = np.int64(x * _DECAY_STEPS + 0.5)
    rest = x - entry * (1.0 / _DECAY_STEPS)
    return _DECAY[np.uintp(entry)] * (1.0 - rest * (1.0 - 0.5 * rest))


@kernel
def _entry(gap):
    """Return the row of the noise table for a gap."""
    # By way of a signed integer: converting to an unsigned one is slow.
    return np.uintp(np.int64((min(max(gap, GAP_MIN), GAP_MAX) - GAP_MIN) * GAP_STEPS))


@kernel
def _cost(old, new, per_gap_us, step_us, table):
    """Return the risk spent while the gap went from entry ``old`` to ``new`` at a steady pace."""
    frozen = max(0.0, table[new, _SHARE] - table[old, _SHARE])
    moved = (table[new, _SUM] - table[old, _SUM]) * per_gap_us
    rested = table[new, _RATE] * step_us
    passed = rested if old == new else moved
    return max(passed, frozen) + 0.6 * min(passed, frozen)


@kernel
def _part(first, last, rest, cost):
    """Return the part of a step in which ``rest`` of its ``cost`` is spent, at an even growth."""
    first, last = first + 1e-300, last + 1e-300
    root = math.sqrt(cost * (cost * first * first + rest * (last * last - first * first)))
    return rest * (first + last) / (cost * first + root)


@kernel
def _gap(value, per_level, per_noise, sign):
    """Return the distance of y from a level in standard deviations, positive inside the band.

    ``log(1 + x) / noise`` by its series, which is accurate near the level and grows far from it.
    """
    x = sign * (value * per_level - 1.0)
    return x * (1.0 + x * (x * (1 / 3) - sign * 0.5)) * per_noise


class _Start(NamedTuple):
    """The two exponentials ``a`` and ``b`` where a summation begins, and its first step.

    ``fade`` are their factors over the step, ``bend`` their second derivatives relative to
    themselves, 1/us2.
    """

    a: float
    b: float
    step_us: float
    fade_a: float
    fade_b: float
    bend_a: float
    bend_b: float


@kernel(inline="always")
def _start(signal, noise, from_us):
    """Return the begin of a summation at ``from_us``."""
    settled, tau_us = signal.settled, signal.tau_us
    a, b, follower_us = _shares(signal)
    rate_a, rate_b = 1.0 / tau_us, 1.0 / follower_us
    fade_a, fade_b = _decay(from_us * rate_a), _decay(from_us * rate_b)
    a *= fade_a
    b *= fade_b
    bend_a, bend_b = rate_a * rate_a, rate_b * rate_b
    # A step h bends the path of the gap by h^2/8 times its second derivative.
    bend = abs(a) * bend_a + abs(b) * bend_b
    scale = (settled + a + b) * noise
    room = 8.0 * _BEND * scale
    step_us = from_us
    # A step as long as the time before it is mostly right and needs no further exponentials.
    if not 0.0 < bend * from_us * from_us < room:
        step_us = min(math.sqrt(room / (bend + 1e-300)), 0.5 * tau_us)
        fade_a, fade_b = _decay(step_us * rate_a), _decay(step_us * rate_b)
    return _Start(a, b, step_us, fade_a, fade_b, bend_a, bend_b)


@kernel(inline="always")
def _noisy(signal, levels, middle, noise, table, from_us, until_us, budget):
    """Return time from now and polarity of the first passage of y with noise.

    Sums up the risk from ``from_us`` on until it reaches ``budget``, in steps over which the gaps
    change at a nearly steady pace. A moving signal can pass the nearer level only, the one on
    its side of ``middle``. Returns UNKNOWN when there is no passage up to ``until_us`` and the
    signal still moves: call again later. The steps do not depend on ``until_us``.
    """
    start = _start(signal, noise, from_us)
    a, b, step_us, fade_a, fade_b = start.a, start.b, start.step_us, start.fade_a, start.fade_b
    bend_a, bend_b = start.bend_a, start.bend_b
    settled = signal.settled
    per_noise, per_on, per_off = 1.0 / noise, 1.0 / levels.on, 1.0 / levels.off
    value = settled + a + b
    t, spent = from_us, 0.0
    old_sign, old_gap, old = 0.0, 0.0, np.uintp(0)
    for _ in range(_STEPS_MAX):
        sign = 1.0 if value < middle else -1.0
        per_level = per_on if value < middle else per_off
        gap = _gap(value, per_level, per_noise, sign)
        entry = _entry(gap)
        if old_sign != 0.0:
            if sign != old_sign:
                old_gap = GAP_MAX + 1.0
                old = _entry(old_gap)
            pace = step_us / (old_gap - gap)
            cost = _cost(old, entry, pace, step_us, table)
            if spent + cost >= budget:
                part = _part(table[old, _RATE], table[entry, _RATE], budget - spent, cost)
                return t - step_us * (1.0 - part), ON if sign > 0.0 else OFF
            spent += cost
        scale = value * noise
        if abs(a) + abs(b) < 0.05 * scale:
            per_other = per_off if value < middle else per_on
            other = _entry(_gap(value, per_other, per_noise, -sign))
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
