"""One pixel over time: it is updated when its light changes or its own event is due.

A pixel is anchored at ``t``, the time its light last changed or its refractory period ended.
Nothing else moves the anchor and every draw is a hash of pixel and time, so that its events do not
depend on when else it is processed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.simulation.pixels._passage import GAP_MAX, _noisy
from eschorty_ros.simulation.pixels._prompt import _prompt
from eschorty_ros.simulation.pixels._response import (
    NOTHING,
    UNKNOWN,
    Levels,
    Signal,
    _advanced,
    _earliest_us,
    _fade,
    _noiseless,
)

PIXEL_DTYPE = np.dtype(
    [
        ("u", "f8"),  # photoreceptor at the anchor
        ("y", "f8"),  # source follower at the anchor
        ("y_ref", "f8"),  # comparator reference
        ("u_settled", "f8"),  # 1 / I: final value of both
        ("t", "f8"),  # anchor, us
        ("t_next", "f8"),  # time of the next change, us; its kind is given by state
        ("on_factor", "f4"),  # exp(-theta_on)
        ("off_factor", "f4"),  # exp(theta_off)
        ("state", "i8"),
    ],
    align=True,
)

# States: OFF and ON = an event at t_next; WAITS = nothing before t_next; HELD = until t_next.
WAITS, HELD = 2, 3
FULL = -1.0
"""Instead of a time: the output has no room left."""
_AT_REST = 0.1
"""Lag of y behind u that counts as none, standard deviations of the noise."""


class Model(NamedTuple):
    """Parameters that all pixels share, times in us; the tables are those of the noise."""

    omega_per_us: float
    follower_us: float
    noise: float
    refractory_us: float
    refractory_jitter: float
    latency_us: float
    latency_jitter_us: float
    seed: np.uint64
    risks: NDArray[np.float64]
    ways: NDArray[np.float32]
    gaps: NDArray[np.float32]


@kernel
def _mix(value):
    """Return 64 well mixed bits of a counter: one round of splitmix64."""
    value = np.uint64(value) + np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@kernel
def _bits(t_us, column, row, seed, purpose):
    """Return 64 random bits for one purpose of a pixel at a time."""
    place = np.uint64((column << 12) | row) * np.uint64(0xD6E8FEB86659FD93)
    salt = np.uint64(purpose) * np.uint64(0xA0761D6478BD642F)
    return _mix((place ^ np.uint64(seed)) + salt + np.uint64(np.int64(t_us * 1024.0)))


@kernel
def _gaussian(bits):
    """Return the sum of four 16-bit numbers as a Gaussian of standard deviation 1 cut at 3.5."""
    low = np.uint64(0x0000FFFF0000FFFF)
    pairs = (bits & low) + ((bits >> np.uint64(16)) & low)
    total = np.int64(pairs & np.uint64(0xFFFFFFFF)) + np.int64(pairs >> np.uint64(32))
    return (np.float64(total) - 131070.0) * (math.sqrt(3.0) / 65536.0)


@kernel
def _uniform(bits):
    """Return a number between 0 and 1, neither included."""
    return (np.float64(bits >> np.uint64(11)) + 0.5) * 2.0**-53


@kernel
def _key(t_us, column, row, polarity):
    """Return an event as one sortable integer: time (us, rounded up), row, polarity, column."""
    return (np.int64(np.ceil(t_us)) << 22) | (row << 12) | (polarity << 11) | column


@kernel
def _levels(pixel, y_ref):
    return Levels(y_ref * np.float64(pixel.on_factor), y_ref * np.float64(pixel.off_factor))


@kernel
def _live(pixels, column, begin, end, until_us, light, model, out, n):
    """Process rows [begin, end) up to ``until_us``, then set their light to ``light``.

    An empty ``light`` leaves theirs unchanged. Returns the number of events in ``out`` and the
    earliest time something is due in these rows, ``FULL`` when the output had no room: call again
    with more.
    """
    omega, follower_us, noise = model.omega_per_us, model.follower_us, model.noise
    seed, risks = model.seed, model.risks
    reach = math.exp(GAP_MAX * noise)
    earliest = np.inf
    relit = light.size > 0
    for row in range(begin, end):
        pixel = pixels[np.uintp(column), np.uintp(row)]
        t_next = pixel.t_next
        if t_next > until_us and not relit:
            earliest = min(earliest, t_next)
            continue
        # Locals: the compiler cannot exclude that ``out`` and the pixel overlap.
        u, y, settled, t, y_ref = pixel.u, pixel.y, pixel.u_settled, pixel.t, pixel.y_ref
        levels = _levels(pixel, y_ref)
        state = pixel.state
        tau_us = settled / omega
        full = False
        while t_next <= until_us:
            if state == WAITS:
                signal = Signal(u, y, settled, tau_us, follower_us)
                if noise > 0.0:
                    budget = -math.log(_uniform(_bits(t, column, row, seed, 1)))
                    after_us, what = _noisy(
                        signal, levels, y_ref, noise, risks, t_next - t, until_us - t, budget
                    )
                else:
                    after_us, what = _noiseless(signal, levels)
                if what == UNKNOWN:
                    break
                t_next = t + after_us
                if what != NOTHING:
                    state = what
            elif state == HELD:
                u, y = _advanced(Signal(u, y, settled, tau_us, follower_us), t_next - t)
                t = t_next
                y_ref = y
                if noise > 0.0:
                    y_ref *= _fade(noise * _gaussian(_bits(t, column, row, seed, 2)))
                levels = _levels(pixel, y_ref)
                state = WAITS
                signal = Signal(u, y, settled, tau_us, follower_us)
                t_next = _earliest_us(signal, t, levels, reach)
            else:
                if n == out.size:
                    full = True
                    break
                bits = _bits(t_next, column, row, seed, 3)
                late_us = max(1.0, model.latency_us + model.latency_jitter_us * _gaussian(bits))
                out[np.uintp(n)] = _key(t_next + late_us, column, row, state)
                n += 1
                state = HELD
                held_us = model.refractory_us
                if model.refractory_jitter > 0.0:
                    held_us *= max(0.0, 1.0 + model.refractory_jitter * _gaussian(_mix(bits)))
                t_next += max(1.0, held_us)
        if relit and not full:
            u, y = _advanced(Signal(u, y, settled, tau_us, follower_us), until_us - t)
            t = until_us
            settled = 1.0 / light[np.uintp(row)]
            pixel.u_settled = settled
            if state != HELD:
                state = WAITS
                signal = Signal(u, y, settled, settled / omega, follower_us)
                t_next = _earliest_us(signal, t, levels, reach)
        pixel.u = u
        pixel.y = y
        pixel.t = t
        pixel.y_ref = y_ref
        pixel.state = state
        pixel.t_next = t_next
        if full:
            return n, FULL
        earliest = min(earliest, t_next)
    return n, earliest


@kernel
def _look_up(pixels, column, begin, end, model):
    """Look up the next event of the rows [begin, end) just lit that start from rest.

    A separate pass, since without branches on the pixel's state the processor overlaps several
    pixels. Other rows are left to :func:`_live`.
    """
    omega, follower_us, noise = model.omega_per_us, model.follower_us, model.noise
    seed, ways, gaps = model.seed, model.ways, model.gaps
    for row in range(begin, end):
        pixel = pixels[np.uintp(column), np.uintp(row)]
        u, y, t, settled = pixel.u, pixel.y, pixel.t, pixel.u_settled
        waits = pixel.state == WAITS and t < pixel.t_next < np.inf
        if not (waits and abs(u - y) < _AT_REST * noise * u):
            continue
        signal = Signal(u, y, settled, settled / omega, follower_us)
        levels = _levels(pixel, pixel.y_ref)
        draw = _uniform(_bits(t, column, row, seed, 1))
        after_us, what = _prompt(signal, levels, noise, ways, gaps, draw)
        if what != UNKNOWN:
            pixel.state = what
            pixel.t_next = t + after_us


class _Due(NamedTuple):
    """Rows [begin, end) of a column with something due, and the earliest time of it."""

    begin: int
    end: int
    earliest_us: float


@kernel
def _rebias(pixels, column, t_us, before, after):
    """Anchor the pixels of a column at ``t_us``, up to which they have been run.

    ``before`` and ``after`` are the models; the pixels' thresholds are the new ones already. The
    next event is that of the new biases, and a refractory time under way keeps its length.
    """
    reach = math.exp(GAP_MAX * after.noise)
    rows = pixels.shape[1]
    begin, end, earliest = rows, 0, np.inf
    for row in range(rows):
        pixel = pixels[np.uintp(column), np.uintp(row)]
        u, y, y_ref, settled = pixel.u, pixel.y, pixel.y_ref, pixel.u_settled
        never_lit = u == settled and y == settled and y_ref == settled
        if pixel.t_next == np.inf and never_lit:
            continue
        signal = Signal(u, y, settled, settled / before.omega_per_us, before.follower_us)
        u, y = _advanced(signal, t_us - pixel.t)
        pixel.u, pixel.y, pixel.t = u, y, t_us
        if pixel.state != HELD:
            pixel.state = WAITS
            signal = Signal(u, y, settled, settled / after.omega_per_us, after.follower_us)
            pixel.t_next = _earliest_us(signal, t_us, _levels(pixel, y_ref), reach)
        if pixel.t_next < np.inf:
            begin, end = min(begin, row), row + 1
            earliest = min(earliest, pixel.t_next)
    return _Due(min(begin, end), end, earliest)
