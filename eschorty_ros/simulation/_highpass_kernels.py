"""A comparator whose reference forgets: the high-pass behind the follower, in closed form.

While a pixel waits, its reference follows the signal, ``dm/dt = (y - m) / tau_h``: what changes
slowly leaves no difference. The comparator sees ``y / m`` and fires at ``exp(-theta_on)`` or
``exp(theta_off)``, that is where ``y - m exp(..)`` vanishes, a constant and three exponentials.

Notation: ``w``, ``e``, ``g`` are photoreceptor, follower and reference less ``1 / I``, where all
three are heading, and ``x``, ``z``, ``k`` a time in the time constants of each. Of a chain of
low-passes nothing but divided differences of ``exp(-x)`` is needed; they are positive, and equal
time constants are no special case.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from eschorty_ros.simulation._response_kernels import NOTHING, OFF, ON

_SERIES_TERMS = 16
_CLOSE = 0.3
"""Exponents nearer than this are taken apart by series: half a unit in the last place."""
_STEPS_MAX = 200
_AFTER = 60.0
"""Sum of the time constants after which the slowest exponential alone is left."""


@njit(cache=True, nogil=True, error_model="numpy")
def _first_difference(low, high, at_low, at_high):
    """``(exp(-low) - exp(-high)) / (high - low)`` with the exponentials given; also for equals."""
    apart = high - low
    if apart > _CLOSE:
        return (at_low - at_high) / apart
    total = 1.0
    for order in range(12, 1, -1):
        total = 1.0 - total * apart / order
    return at_low * total


@njit(cache=True, nogil=True, error_model="numpy")
def _second_difference(low, middle, high, at_low, at_middle, at_high):
    """Second divided difference of ``exp(-x)``; 1/2 where all three are 0."""
    if high - low > _CLOSE:
        below = _first_difference(low, middle, at_low, at_middle)
        above = _first_difference(middle, high, at_middle, at_high)
        return (below - above) / (high - low)
    # Complete homogeneous polynomials of the distances to the middle, over factorials.
    down, up = middle - low, middle - high
    term, power, factorial, total = 1.0, 1.0, 2.0, 0.5
    for order in range(1, _SERIES_TERMS):
        power *= up
        term = down * term + power
        factorial *= order + 2.0
        total += term / factorial
    return at_middle * total


@njit(cache=True, nogil=True, error_model="numpy")
def _ordered(x, z, at_x, at_z):
    """Two exponents and their exponentials, the lower exponent first."""
    return (x, z, at_x, at_z) if x <= z else (z, x, at_z, at_x)


@njit(cache=True, nogil=True, error_model="numpy")
def _transition(tau_us, follower_us, highpass_us, t_us):
    """What ``t_us`` of constant light makes of ``w``, ``e`` and ``g``: six numbers from 0 to 1.

    Of each what is left of itself, then what reaches e from w, g from e, and g from w.
    """
    x, z, k = t_us / tau_us, t_us / follower_us, t_us / highpass_us
    at_x, at_z, at_k = math.exp(-x), math.exp(-z), math.exp(-k)
    w_to_e = z * _first_difference(*_ordered(x, z, at_x, at_z))
    e_to_g = k * _first_difference(*_ordered(z, k, at_z, at_k))
    low, high, at_low, at_high = _ordered(x, z, at_x, at_z)
    middle, high, at_middle, at_high = _ordered(high, k, at_high, at_k)
    low, middle, at_low, at_middle = _ordered(low, middle, at_low, at_middle)
    second = _second_difference(low, middle, high, at_low, at_middle, at_high)
    # z first: z times the second difference stays below 1 where z alone is huge.
    return at_x, at_z, at_k, w_to_e, e_to_g, k * (z * second)


@njit(cache=True, nogil=True, error_model="numpy")
def _moved(w, e, g, tau_us, follower_us, highpass_us, t_us):
    """``w``, ``e`` and ``g`` after ``t_us`` of constant light."""
    w_left, e_left, g_left, w_to_e, e_to_g, w_to_g = _transition(
        tau_us, follower_us, highpass_us, t_us
    )
    return w * w_left, e * e_left + w * w_to_e, g * g_left + e * e_to_g + w * w_to_g


@njit(cache=True, nogil=True, error_model="numpy")
def _forgotten(u, y, reference, settled, tau_us, follower_us, highpass_us, t_us):
    """Reference after ``t_us`` of constant light."""
    _, _, left, _, e_to_g, w_to_g = _transition(tau_us, follower_us, highpass_us, t_us)
    driven = (y - settled) * e_to_g + (u - settled) * w_to_g
    k = t_us / highpass_us
    if k < 0.01:
        return reference + ((reference - settled) * math.expm1(-k) + driven)
    return settled + ((reference - settled) * left + driven)


@njit(cache=True, nogil=True, error_model="numpy")
def _excess(w, e, g, settled, tau_us, follower_us, highpass_us, factor, t_us):
    """``y - factor m`` at ``t_us`` with its first and second derivative."""
    w, e, g = _moved(w, e, g, tau_us, follower_us, highpass_us, t_us)
    pace = (w - e) / follower_us
    follows = (e - g) / highpass_us
    bend = (-w / tau_us - pace) / follower_us
    return (
        settled * (1.0 - factor) + e - factor * g,
        pace - factor * follows,
        bend - factor * (pace - follows) / highpass_us,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _zero(w, e, g, settled, tau_us, follower_us, highpass_us, factor, derivative, lo_us, hi_us):
    """Time in [lo, hi] at which the excess or its derivative passes 0: Newton kept in a bracket.

    Between ``lo_us`` and ``hi_us`` it must change its sign once.
    """
    model = w, e, g, settled, tau_us, follower_us, highpass_us, factor
    begin = _excess(*model, lo_us)[derivative]
    t = lo_us
    for _ in range(_STEPS_MAX):
        values = _excess(*model, t)
        off, slope = values[derivative], values[derivative + 1]
        if off * begin > 0.0:
            lo_us = t
        else:
            hi_us = t
        new = t - off / slope if slope != 0.0 else np.inf
        if not lo_us < new < hi_us:
            new = 0.5 * (lo_us + hi_us)
        if abs(new - t) <= 1e-13 * new:
            return new
        t = new
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def _inflection_us(w, e, tau_us, follower_us, highpass_us, factor):
    """When ``exp(t / tau_h)`` times the derivative of the excess turns round; 0 for never.

    Two exponentials are left of its derivative, so it does so at most once.
    """
    rate_x, rate_z = 1.0 / tau_us, 1.0 / follower_us
    apart = rate_z - rate_x
    weight = rate_z - (1.0 - factor) / highpass_us
    lag = w - e
    ratio = (rate_x * w + weight * lag) / (weight * (lag * apart + rate_x * w))
    change = -apart * ratio
    if not -1.0 < change < np.inf:
        return 0.0
    t_us = -math.log1p(change) / apart if change != 0.0 else ratio
    return t_us if 0.0 < t_us < np.inf else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _passage_us(u, y, reference, settled, tau_us, follower_us, highpass_us, factor):
    """First time at which y is ``factor`` times its reference; ``inf`` for never.

    The excess turns round at most twice, once on either side of ``_inflection_us``: three
    monotone pieces. In the last it goes to where it came from, since y and its reference settle
    on one level.
    """
    model = (
        u - settled, y - settled, reference - settled, settled, tau_us, follower_us, highpass_us,
        factor,
    )  # fmt: skip
    side = 1.0 - factor
    last_us = _AFTER * (tau_us + follower_us + highpass_us)
    parting_us = min(
        _inflection_us(model[0], model[1], tau_us, follower_us, highpass_us, factor), last_us
    )
    begin_us = 0.0
    for piece in range(2):
        lo_us, hi_us = (0.0, parting_us) if piece == 0 else (parting_us, last_us)
        if not lo_us < hi_us:
            continue
        # A signal that leaves the level at the end of a piece was nearer to it before.
        if not side * _excess(*model, hi_us)[1] > 0.0 > side * _excess(*model, lo_us)[1]:
            continue
        nearest_us = _zero(*model, 1, lo_us, hi_us)
        if side * _excess(*model, nearest_us)[0] <= 0.0:
            return _zero(*model, 0, begin_us, nearest_us)
        begin_us = nearest_us
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _noiseless_highpass(
    u, y, reference, settled, tau_us, follower_us, highpass_us, on_factor, off_factor
):
    """Time from now and polarity of the first passage of y; NOTHING when there is none."""
    if y <= on_factor * reference:
        return 0.0, ON
    if y >= off_factor * reference:
        return 0.0, OFF
    lowest, highest = min(u, y, settled), max(u, y, settled)
    on_us = off_us = np.inf
    if lowest < on_factor * max(reference, highest):
        on_us = _passage_us(
            u, y, reference, settled, tau_us, follower_us, highpass_us, on_factor
        )  # fmt: skip
    if highest > off_factor * min(reference, lowest):
        off_us = _passage_us(
            u, y, reference, settled, tau_us, follower_us, highpass_us, off_factor
        )  # fmt: skip
    if on_us == off_us:
        return np.inf, NOTHING
    return (on_us, ON) if on_us < off_us else (off_us, OFF)


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_levels(pixel, u, y, reference):
    """The nearest that either level comes to where a signal sets out, as y goes one way."""
    highest, lowest = max(reference, u, y), min(reference, u, y)
    return highest * np.float64(pixel.on_factor), lowest * np.float64(pixel.off_factor)
