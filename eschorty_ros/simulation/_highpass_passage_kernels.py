"""When a comparator whose reference forgets fires early because of noise.

As in ``_passage_kernels``, but the gap is between ``y / m`` and its level, and both move: a step
of the summation is six positive numbers (``_transition``), and twice as long a step their square.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from eschorty_ros.simulation._highpass_kernels import _moved, _noiseless_highpass, _transition
from eschorty_ros.simulation._passage_kernels import (
    _BEND,
    _RATE,
    _STEPS_MAX,
    GAP_MAX,
    _cost,
    _entry,
    _gap,
    _part,
)
from eschorty_ros.simulation._response_kernels import NOTHING, OFF, ON, UNKNOWN

_REST = 0.05
"""What is left of a movement that counts as none, standard deviations of the noise."""


@njit(cache=True, nogil=True, error_model="numpy")
def _bend(w, e, g, rate_x, rate_z, rate_k):
    """Bound of the second derivatives of y and of its reference together."""
    lag, apart = w - e, abs(rate_z - rate_x)
    bend = rate_z * (rate_x * abs(w) + rate_z * abs(lag))
    # Far apart, the two exponentials of y say more; close together they grow without limit.
    if apart > 0.1 * rate_z:
        a = w * rate_z / (rate_z - rate_x)
        bend = min(bend, abs(a) * rate_x * rate_x + abs(e - a) * rate_z * rate_z)
    return bend + rate_k * (rate_z * abs(lag) + rate_k * abs(e - g))


@njit(cache=True, nogil=True, error_model="numpy")
def _squared(step):
    """The same step once more."""
    w_left, e_left, g_left, w_to_e, e_to_g, w_to_g = step
    return (
        w_left * w_left,
        e_left * e_left,
        g_left * g_left,
        w_to_e * (w_left + e_left),
        e_to_g * (e_left + g_left),
        w_to_g * (w_left + g_left) + w_to_e * e_to_g,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _noisy_highpass(
    u, y, reference, settled, tau_us, follower_us, highpass_us, on_factor, off_factor, noise,
    table, from_us, until_us, budget,
):  # fmt: skip
    """Time from now and polarity of the first passage of y with noise; as ``_noisy``.

    Returns UNKNOWN only while y itself moves: a reference that drifts slowly to its place is
    followed there at once.
    """
    w, e, g = _moved(
        u - settled, y - settled, reference - settled, tau_us, follower_us, highpass_us, from_us
    )
    rate_x, rate_z, rate_k = 1.0 / tau_us, 1.0 / follower_us, 1.0 / highpass_us
    per_noise, per_on, per_off = 1.0 / noise, 1.0 / on_factor, 1.0 / off_factor
    value, middle = settled + e, settled + g
    bend = _bend(w, e, g, rate_x, rate_z, rate_k)
    room = 8.0 * _BEND * min(value, middle) * noise
    step_us = from_us
    if not 0.0 < bend * from_us * from_us < room:
        step_us = min(math.sqrt(room / (bend + 1e-300)), 0.5 * max(tau_us, highpass_us))
    step = _transition(tau_us, follower_us, highpass_us, step_us)
    t, spent = from_us, 0.0
    old_sign, old_gap, old = 0.0, 0.0, np.uintp(0)
    for _ in range(_STEPS_MAX):
        ratio = value / middle
        sign = 1.0 if ratio < 1.0 else -1.0
        gap = _gap(ratio, per_on if ratio < 1.0 else per_off, noise, per_noise, sign)
        entry = _entry(gap)
        if old_sign != 0.0:
            if sign != old_sign:
                old_gap = GAP_MAX + 1.0
                old = _entry(old_gap)
            cost = _cost(old, entry, step_us / (old_gap - gap), step_us, table)
            if spent + cost >= budget:
                part = _part(table[old, _RATE], table[entry, _RATE], budget - spent, cost)
                return t - step_us * (1.0 - part), ON if sign > 0.0 else OFF
            spent += cost
        scale = min(value, middle) * noise
        rests = abs(w) + abs(e) < _REST * scale
        if rests and abs(g) < _REST * scale:
            per_other = per_off if ratio < 1.0 else per_on
            other = _entry(_gap(ratio, per_other, noise, per_noise, -sign))
            rate = table[entry, _RATE] + table[other, _RATE]
            if rate == 0.0:
                return np.inf, NOTHING
            return t + (budget - spent) / rate, ON if sign > 0.0 else OFF
        if t > until_us and not rests:
            return np.inf, UNKNOWN
        bend = _bend(w, e, g, rate_x, rate_z, rate_k)
        if bend * step_us * step_us < 2.0 * _BEND * scale:
            step_us *= 2.0
            step = _squared(step)
        old_sign, old_gap, old = sign, gap, entry
        w_left, e_left, g_left, w_to_e, e_to_g, w_to_g = step
        g = g * g_left + e * e_to_g + w * w_to_g
        e = e * e_left + w * w_to_e
        w = w * w_left
        value, middle = settled + e, settled + g
        t += step_us
    return np.inf, UNKNOWN


@njit(cache=True, nogil=True, error_model="numpy")
def _passage_highpass(
    u, y, reference, settled, tau_us, follower_us, highpass_us, on_factor, off_factor, noise,
    table, from_us, until_us, draw,
):  # fmt: skip
    """Time from now and polarity of the first passage of y; ``draw`` is a number from 0 to 1."""
    if noise == 0.0:
        return _noiseless_highpass(
            u, y, reference, settled, tau_us, follower_us, highpass_us, on_factor, off_factor
        )  # fmt: skip
    return _noisy_highpass(
        u, y, reference, settled, tau_us, follower_us, highpass_us, on_factor, off_factor, noise,
        table, from_us, until_us, -math.log(draw),
    )  # fmt: skip
