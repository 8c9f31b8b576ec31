"""The pixel model stepped finely in time, straight from its equations: slow and plain."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from eschorty_ros.simulation.pixel import PixelParameters


@njit(cache=True)
def _step(intensity, dark, thresholds, half_us, duration_us, dt_us, p, seed, out):
    """Counts per pixel and polarity; events (time, pixel, polarity) go to ``out``."""
    np.random.seed(seed)  # noqa: NPY002 - numba's own generator
    omega, tau_us, refractory_us, noise, leak = p[0], p[1], p[2], p[3], p[4]
    forgets = -math.expm1(-dt_us * p[5])
    a = 1.0 - math.exp(-dt_us / tau_us)
    injected = noise * math.sqrt((2.0 - a) / a)
    n = 0
    steps = round(duration_us / dt_us)
    for k in range(intensity.size):
        on, off = thresholds[0, k], thresholds[1, k]
        u, v, ref, ready = 1.0 / dark, math.log(dark), math.log(dark), 0.0
        bright_decay = math.exp(-omega * intensity[k] * dt_us)
        dark_decay = math.exp(-omega * dark * dt_us)
        for i in range(steps):
            t = i * dt_us
            if (t // half_us) % 2 == 0.0:
                u = 1.0 / intensity[k] + (u - 1.0 / intensity[k]) * bright_decay
            else:
                u = 1.0 / dark + (u - 1.0 / dark) * dark_decay
            v += a * (-math.log(u) + injected * np.random.standard_normal() - v)  # noqa: NPY002
            if t < ready:
                ref = v
                continue
            ref += forgets * (v - ref) - leak * on * dt_us
            if v - ref > on or v - ref < -off:
                if n < out.shape[0]:
                    out[n, 0], out[n, 1], out[n, 2] = t + dt_us, k, 1.0 if v > ref else 0.0
                n += 1
                ready = t + dt_us + refractory_us
                ref = v
    return n


@njit(cache=True)
def _slopes(u, y, m, settled, rates):
    return (settled - u) * rates[0], (u - y) * rates[1], (y - m) * rates[2]


@njit(cache=True)
def _runge_kutta(state, settled, rates, dt_us):
    """One step of fourth order of photoreceptor, follower and reference."""
    u, y, m = state
    a = _slopes(u, y, m, settled, rates)
    h = 0.5 * dt_us
    b = _slopes(u + h * a[0], y + h * a[1], m + h * a[2], settled, rates)
    c = _slopes(u + h * b[0], y + h * b[1], m + h * b[2], settled, rates)
    d = _slopes(u + dt_us * c[0], y + dt_us * c[1], m + dt_us * c[2], settled, rates)
    s = dt_us / 6.0
    return (
        u + s * (a[0] + 2.0 * (b[0] + c[0]) + d[0]),
        y + s * (a[1] + 2.0 * (b[1] + c[1]) + d[1]),
        m + s * (a[2] + 2.0 * (b[2] + c[2]) + d[2]),
    )


@njit(cache=True)
def integrated(state, settled, rates, factors, until_us, dt_us):
    """Photoreceptor, follower and reference stepped finely up to the first passage.

    ``rates`` of the three per us, ``factors`` the ON and the OFF level over the reference. Returns
    the time of the passage or ``until_us``, the state there, and 1 for ON, 0 for OFF, -1 for none.
    """
    steps = math.ceil(until_us / dt_us)
    for k in range(steps):
        step_us = min(dt_us, until_us - k * dt_us)
        after = _runge_kutta(state, settled, rates, step_us)
        on, off = after[1] <= factors[0] * after[2], after[1] >= factors[1] * after[2]
        if on or off:
            factor = factors[0] if on else factors[1]
            lo, hi = 0.0, step_us
            for _ in range(60):
                middle = 0.5 * (lo + hi)
                after = _runge_kutta(state, settled, rates, middle)
                passed = after[1] <= factor * after[2] if on else after[1] >= factor * after[2]
                lo, hi = (lo, middle) if passed else (middle, hi)
            return k * dt_us + hi, after, 1 if on else 0
        state = after
    return until_us, state, -1


def stepped(
    parameters: PixelParameters,
    frequency_hz: float,
    seconds: float,
    offsets: np.ndarray,
    seed: int,
    dt_us: float = 1.0,
) -> np.ndarray:
    """Events under a square wave of duty 1/2, shape (n, 3): time (us), pixel, polarity.

    ``offsets``, one per pixel, are distances from the line's centre in rows.
    """
    p = parameters
    intensity = p.background_intensity + p.amplitude * np.exp(-0.5 * (offsets / p.sigma_rows) ** 2)
    rng = np.random.default_rng(seed)
    spread = 1.0 + p.threshold_mismatch * rng.standard_normal((2, offsets.size))
    thresholds = np.maximum(np.array([[p.threshold_on], [p.threshold_off]]) * spread, 0.03)
    constants = np.array(
        [
            p.omega_per_us,
            1e6 / (2.0 * math.pi * p.follower_hz),
            p.refractory_us,
            p.noise,
            p.leak_hz * 1e-6,
            1.0 / p.highpass_us,
        ]
    )
    out = np.empty((int(offsets.size * seconds * 3e3) + 1000, 3))
    n = _step(
        intensity, p.background_intensity, thresholds, 5e5 / frequency_hz, seconds * 1e6, dt_us,
        constants, seed, out,
    )  # fmt: skip
    assert n <= len(out)
    return out[:n]
