"""Event-driven pixels: each one is touched when its light changes or its own event is due.

Notation of the photoreceptor: with ``u = exp(-v) = 1 / x`` the response to a constant relative
photocurrent ``I`` is ``u(t) = 1/I + (u0 - 1/I) exp(-omega0 I t)``, and the comparator's levels
``v_ref + theta_on`` and ``v_ref - theta_off`` become ``u_ref exp(-theta_on)`` and
``u_ref exp(theta_off)``. A pixel is anchored at ``t``, the time its light last changed or its
refractory period ended; nothing else moves the anchor, so that looking at a pixel in between
does not change what it does.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

PIXEL_DTYPE = np.dtype(
    [
        ("u", "f8"),  # photoreceptor at the anchor
        ("u_ref", "f8"),  # comparator reference
        ("u_settled", "f8"),  # 1 / I: where the photoreceptor is heading
        ("rate", "f8"),  # omega0 I, per us
        ("t", "f8"),  # anchor, us
        ("t_next", "f8"),  # next threshold crossing or end of the refractory period, us
        ("on_factor", "f4"),  # exp(-theta_on)
        ("off_factor", "f4"),  # exp(theta_off)
        ("refractory", "i8"),  # 1 while v_ref follows v
    ],
    align=True,
)

# An exponential this far gone is below half a unit in the last place of what it is added to.
_SETTLED = 38.0
_JITTER_UNIT = math.sqrt(3.0) / 65536.0


@njit(cache=True, nogil=True)
def _mix(value):
    """One round of splitmix64: 64 well mixed bits from a counter."""
    value = np.uint64(value) + np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, nogil=True)
def _readout_key(t_us, column, row, polarity, slot_us):
    """Event as one sortable integer: time of the row's next readout slot, row, polarity, column.

    Every row is read at a fixed phase of the slot, so that neighbours are read one after another.
    """
    phase = (row * 7) % slot_us
    slot = (np.int64(math.ceil(t_us)) - phase + slot_us - 1) // slot_us
    return ((slot * slot_us + phase) << 22) | (row << 12) | (polarity << 11) | column


@njit(cache=True, nogil=True)
def _latency_us(t_us, column, row, seed, timing):
    """Latency of one event: a Gaussian (sum of four uniforms) drawn from what the event is."""
    place = np.uint64((column << 12) | row) ^ np.uint64(seed)
    bits = _mix(_mix(place) ^ np.uint64(np.int64(t_us * 1024.0)))
    total = 0.0
    for _ in range(4):
        total += np.float64(bits & np.uint64(0xFFFF))
        bits >>= np.uint64(16)
    return max(1.0, timing[0] + timing[1] * (total - 131070.0) * _JITTER_UNIT)


@njit(cache=True, nogil=True)
def _arm(pixel):
    """Predict the next threshold crossing from the anchor."""
    on_level = pixel.u_ref * pixel.on_factor
    off_level = pixel.u_ref * pixel.off_factor
    if pixel.u_settled < on_level:
        level = on_level
        passed = pixel.u <= level
    elif pixel.u_settled > off_level:
        level = off_level
        passed = pixel.u >= level
    else:
        pixel.t_next = np.inf
        return
    if passed:
        pixel.t_next = pixel.t
    else:
        share = (level - pixel.u) / (pixel.u - pixel.u_settled)
        pixel.t_next = pixel.t - math.log1p(share) / pixel.rate


@njit(cache=True, nogil=True)
def _advance(pixel, t_us):
    """Move the anchor to ``t_us`` under constant light."""
    x = pixel.rate * (t_us - pixel.t)
    if x > _SETTLED:
        pixel.u = pixel.u_settled
    else:
        pixel.u -= (pixel.u_settled - pixel.u) * math.expm1(-x)
    pixel.t = t_us


@njit(cache=True, nogil=True)
def _run(pixel, until_us, column, row, seed, timing, out, n):
    """Everything the pixel does by itself up to ``until_us``; returns the grown output."""
    while pixel.t_next <= until_us:
        now = pixel.t_next
        if pixel.refractory:
            _advance(pixel, now)
            pixel.u_ref = pixel.u
            pixel.refractory = 0
            _arm(pixel)
            continue
        rising = pixel.u_settled < pixel.u
        if n >= out.size:
            grown = np.empty(2 * out.size, np.int64)
            grown[: out.size] = out
            out = grown
        late = _latency_us(now, column, row, seed, timing)
        out[n] = _readout_key(now + late, column, row, np.int64(rising), np.int64(timing[3]))
        n += 1
        if now > pixel.t:
            pixel.u = pixel.u_ref * (pixel.on_factor if rising else pixel.off_factor)
            pixel.t = now
        pixel.refractory = 1
        pixel.t_next = now + timing[2]
    return out, n


@njit(cache=True, nogil=True)
def _light(pixel, intensity, omega, t_us, column, row, seed, timing, out, n):
    """Change a pixel's light at ``t_us``."""
    out, n = _run(pixel, t_us, column, row, seed, timing, out, n)
    _advance(pixel, t_us)
    pixel.u_settled = 1.0 / intensity
    pixel.rate = omega * intensity
    if not pixel.refractory:
        _arm(pixel)
    return out, n


@njit(cache=True, nogil=True)
def _relight(pixels, spans, due, columns, line_row, contrast, optics, t_us, seed, timing, out, n):
    """Put the line at ``line_row`` in some columns from ``t_us`` on.

    ``spans`` holds per column the lit rows [0, 1) and the rows with something pending [2, 3);
    ``due`` the earliest pending time. ``optics`` = sigma (rows), least contrast drawn, background
    intensity, omega0 (per us). ``contrast`` 0 leaves the column dark.
    """
    sigma, least, background, omega = optics[0], optics[1], optics[2], optics[3]
    rows = pixels.shape[1]
    step_ratio = math.exp(-1.0 / (sigma * sigma))
    for k in range(columns.size):
        column = columns[k]
        lo = 0
        hi = 0
        if contrast[k] > least and line_row[k] > -1e6 and line_row[k] < 1e6:
            half = sigma * math.sqrt(2.0 * math.log(contrast[k] / least))
            lo = min(max(0, math.ceil(line_row[k] - half)), rows)
            hi = max(lo, min(rows, math.floor(line_row[k] + half) + 1))
        old_lo, old_hi = spans[column, 0], spans[column, 1]
        first = rows
        last = 0
        earliest = due[column]
        for row in range(old_lo, old_hi):
            if row < lo or row >= hi:
                pixel = pixels[column, row]
                out, n = _light(pixel, background, omega, t_us, column, row, seed, timing, out, n)
                earliest = min(earliest, pixel.t_next)
                first = min(first, row)
                last = max(last, row + 1)
        if hi > lo:
            offset = lo - line_row[k]
            value = contrast[k] * math.exp(-0.5 * offset * offset / (sigma * sigma))
            ratio = math.exp(-(offset + 0.5) / (sigma * sigma))
            for row in range(lo, hi):
                pixel = pixels[column, row]
                out, n = _light(
                    pixel, background + value, omega, t_us, column, row, seed, timing, out, n
                )
                earliest = min(earliest, pixel.t_next)
                value *= ratio
                ratio *= step_ratio
            first = min(first, lo)
            last = max(last, hi)
        if due[column] == np.inf:
            spans[column, 2], spans[column, 3] = first, last
        else:
            spans[column, 2] = min(spans[column, 2], first)
            spans[column, 3] = max(spans[column, 3], last)
        due[column] = earliest
        spans[column, 0], spans[column, 1] = lo, hi
    return out, n


@njit(cache=True, nogil=True)
def _run_columns(pixels, spans, due, until_us, seed, timing, out, n):
    """Everything that is due up to ``until_us`` in all columns."""
    for column in range(pixels.shape[0]):
        if due[column] > until_us:
            continue
        earliest = np.inf
        for row in range(spans[column, 2], spans[column, 3]):
            pixel = pixels[column, row]
            if pixel.t_next <= until_us:
                out, n = _run(pixel, until_us, column, row, seed, timing, out, n)
            earliest = min(earliest, pixel.t_next)
        due[column] = earliest
    return out, n


@njit(cache=True, nogil=True)
def _background(process, rate_per_us, until_us, columns, rows, seed, slot_us, out, n):
    """Poisson events over the whole sensor; ``process`` = time of the next one, count so far."""
    while process[0] <= until_us:
        count = np.uint64(process[1])
        bits = _mix(np.uint64(seed) ^ (np.uint64(2) * count))
        place = np.int64((bits >> np.uint64(1)) % np.uint64(columns * rows))
        if n >= out.size:
            grown = np.empty(2 * out.size, np.int64)
            grown[: out.size] = out
            out = grown
        polarity = np.int64(bits & np.uint64(1))
        out[n] = _readout_key(process[0], place % columns, place // columns, polarity, slot_us)
        n += 1
        draw = _mix(np.uint64(seed) ^ (np.uint64(2) * count + np.uint64(1)))
        uniform = (np.float64(draw >> np.uint64(11)) + 0.5) * 2.0**-53
        process[0] -= math.log(uniform) / rate_per_us
        process[1] += 1.0
    return out, n
