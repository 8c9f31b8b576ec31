"""The pixel model stepped finely in time, straight from its equations: slow and plain."""

import math

import numpy as np
from numba import njit

from eschorty_ros.simulation.pixels import PixelParameters


@njit(cache=True)
def _step(intensity, dark, thresholds, half_us, duration_us, dt_us, p, seed, out):
    """Counts per pixel and polarity; events (time, pixel, polarity) go to ``out``."""
    np.random.seed(seed)  # noqa: NPY002 - numba's own generator
    omega, tau_us, refractory_us, noise, leak = p[0], p[1], p[2], p[3], p[4]
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
            ref -= leak * on * dt_us
            if v - ref > on or v - ref < -off:
                if n < out.shape[0]:
                    out[n, 0], out[n, 1], out[n, 2] = t + dt_us, k, 1.0 if v > ref else 0.0
                n += 1
                ready = t + dt_us + refractory_us
                ref = v
    return n


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
    tau_us = 1e6 / (2.0 * math.pi * p.follower_hz)
    constants = np.array([p.omega_per_us, tau_us, p.refractory_us, p.noise, p.leak_hz * 1e-6])
    out = np.empty((int(offsets.size * seconds * 3e3) + 1000, 3))
    n = _step(
        intensity, p.background_intensity, thresholds, 5e5 / frequency_hz, seconds * 1e6, dt_us,
        constants, seed, out,
    )  # fmt: skip
    assert n <= len(out)
    return out[:n]
