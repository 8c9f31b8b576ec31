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


@njit(cache=True, nogil=True, error_model="numpy")
def _mix(value):
    """One round of splitmix64: 64 well mixed bits from a counter."""
    value = np.uint64(value) + np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, nogil=True, error_model="numpy")
def _readout_key(t_us, column, row, polarity, slots):
    """Event as one sortable integer: time of the row's next readout slot, row, polarity, column.

    ``slots`` holds per row the phase of its slots (rows take turns), and last the slot's length
    and one over it.
    """
    slot_us, per_us = slots[np.uintp(slots.size - 2)], slots[np.uintp(slots.size - 1)]
    phase = slots[np.uintp(row)]
    t = np.int64(np.ceil((t_us - phase) * per_us) * slot_us + phase)
    return (t << 22) | (row << 12) | (polarity << 11) | column


@njit(cache=True, nogil=True, error_model="numpy")
def _latency_us(t_us, column, row, seed, timing):
    """Latency of one event: a Gaussian (sum of four uniforms) drawn from what the event is."""
    place = np.uint64((column << 12) | row) * np.uint64(0xD6E8FEB86659FD93)
    bits = _mix((place ^ np.uint64(seed)) + np.uint64(np.int64(t_us * 1024.0)))
    low = np.uint64(0x0000FFFF0000FFFF)
    pairs = (bits & low) + ((bits >> np.uint64(16)) & low)
    total = np.int64(pairs & np.uint64(0xFFFFFFFF)) + np.int64(pairs >> np.uint64(32))
    return max(1.0, timing[0] + timing[1] * (np.float64(total) - 131070.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _crossing_us(u, on_level, off_level, settled, t_us, tau_us):
    """When ``u``, at ``t_us`` and heading for ``settled``, leaves the comparator's band."""
    if settled < on_level:
        level = on_level
        if u <= level:
            return t_us
    elif settled > off_level:
        level = off_level
        if u >= level:
            return t_us
    else:
        return np.inf
    ratio = (level - settled) / (u - settled)
    # log1p where the ratio's own rounding would show, the faster log elsewhere (2e-14 at worst).
    if ratio > 0.99:
        return t_us - tau_us * math.log1p((level - u) / (u - settled))
    return t_us - tau_us * math.log(ratio)


@njit(cache=True, nogil=True, error_model="numpy")
def _response(u, settled, x):
    """Photoreceptor after ``x`` time constants of constant light."""
    if x > _SETTLED:
        return settled
    if x > 0.01:
        return settled + (u - settled) * math.exp(-x)
    return u + (u - settled) * math.expm1(-x)


@njit(cache=True, nogil=True, error_model="numpy")
def _live(pixels, column, lo, hi, until_us, light, omega, seed, timing, slots, out, n):
    """Let rows [lo, hi) do what is due up to ``until_us``, then give them the light ``light``.

    An empty ``light`` leaves theirs as it is. Returns the number of events in ``out`` and the
    earliest time something is due in these rows.
    """
    earliest = np.inf
    inverse_omega = 1.0 / omega
    refractory_us = timing[2]
    relit = light.size > 0
    for row in range(lo, hi):
        pixel = pixels[np.uintp(column), np.uintp(row)]
        t_next = pixel.t_next
        if t_next > until_us and not relit:
            earliest = min(earliest, t_next)
            continue
        # Locals: the compiler cannot know that ``out`` and the pixel do not overlap.
        u, t, settled, rate, u_ref = pixel.u, pixel.t, pixel.u_settled, pixel.rate, pixel.u_ref
        on_factor, off_factor = np.float64(pixel.on_factor), np.float64(pixel.off_factor)
        refractory = pixel.refractory
        tau_us = settled * inverse_omega
        while t_next <= until_us:
            if refractory:
                u = _response(u, settled, (t_next - t) * rate)
                t = t_next
                u_ref = u
                refractory = 0
                t_next = _crossing_us(u, u_ref * on_factor, u_ref * off_factor, settled, t, tau_us)
                continue
            rising = settled < u
            late_us = _latency_us(t_next, column, row, seed, timing)
            out[np.uintp(n)] = _readout_key(t_next + late_us, column, row, np.int64(rising), slots)
            n += 1
            if t_next > t:
                u = u_ref * (on_factor if rising else off_factor)
                t = t_next
            refractory = 1
            t_next = t + refractory_us
        if relit:
            u = _response(u, settled, (until_us - t) * rate)
            t = until_us
            settled = 1.0 / light[np.uintp(row)]
            pixel.u_settled = settled
            pixel.rate = light[np.uintp(row)] * omega
            if not refractory:
                tau_us = settled * inverse_omega
                t_next = _crossing_us(u, u_ref * on_factor, u_ref * off_factor, settled, t, tau_us)
        pixel.u = u
        pixel.t = t
        pixel.u_ref = u_ref
        pixel.refractory = refractory
        pixel.t_next = t_next
        earliest = min(earliest, t_next)
    return n, earliest


@njit(cache=True, nogil=True, error_model="numpy")
def _window(patch, sigma, least, rows):
    """Rows [lo, hi) in which a patch adds at least ``least``; (0, 0) for none."""
    line_row, contrast = patch[0], patch[1]
    if not (contrast > least and abs(line_row) < 1e6):
        return 0, 0
    half = sigma * math.sqrt(2.0 * math.log(contrast / least))
    first = max(math.ceil(line_row - half), math.floor(max(patch[2] + 0.5, 0.0)))
    last = min(math.floor(line_row + half), math.ceil(min(patch[3] - 0.5, rows - 1.0)))
    lo = min(max(0, first), rows)
    return (lo, min(rows, last + 1)) if lo <= last else (0, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_patch(light, lo, hi, patch, sigma):
    """Add a patch of the footprint to ``light`` in rows [lo, hi): a Gaussian by recurrence.

    ``patch`` = row of the line, contrast there, and the rows between which it is lit; a row that
    is lit in part gets its share.
    """
    offset = lo - patch[0]
    value = patch[1] * math.exp(-0.5 * offset * offset / (sigma * sigma))
    ratio = math.exp(-(offset + 0.5) / (sigma * sigma))
    step_ratio = math.exp(-1.0 / (sigma * sigma))
    for row in range(lo, hi):
        share = min(1.0, min(row + 0.5 - patch[2], patch[3] - row + 0.5))
        light[np.uintp(row)] += max(0.0, share) * value
        value *= ratio
        ratio *= step_ratio


@njit(cache=True, nogil=True, error_model="numpy")
def _relight(
    pixels, spans, due, columns, begin, patches, light, optics, t_us, seed, timing, slots, out, n
):
    """Put the footprint ``patches`` (columns, patches, 4) in ``columns[begin:]`` from ``t_us`` on.

    ``spans`` holds per column the lit rows [0, 1) and the rows with something pending [2, 3);
    ``due`` the earliest pending time. ``optics`` = sigma (rows), least contrast drawn, background
    intensity, omega0 (per us), most events of a pixel between two changes of its light.
    ``light`` is room for one column. Stops where the output might not suffice; returns the next
    column to do and the number of events.
    """
    sigma, background, omega = optics[0], optics[2], optics[3]
    rows = pixels.shape[1]
    for k in range(begin, columns.size):
        column = columns[k]
        lo, hi = rows, 0
        for j in range(patches.shape[1]):
            first, last = _window(patches[k, j], sigma, optics[1], rows)
            if last > first:
                lo, hi = min(lo, first), max(hi, last)
        if hi <= lo:
            lo, hi = spans[column, 0], spans[column, 0]
        old_lo, old_hi = spans[column, 0], spans[column, 1]
        if out.size - n < (hi - lo + old_hi - old_lo) * optics[4]:
            return k, n
        light[old_lo:old_hi] = background
        light[lo:hi] = background
        for j in range(patches.shape[1]):
            first, last = _window(patches[k, j], sigma, optics[1], rows)
            _add_patch(light, first, last, patches[k, j], sigma)
        earliest = due[column]
        # One run over both spans, unless they lie apart: the rows between are none of its business.
        first, last = (min(lo, old_lo), max(hi, old_hi)) if hi > lo else (old_lo, old_hi)
        if hi < old_lo or lo > old_hi:
            n, a = _live(
                pixels, column, old_lo, old_hi, t_us, light, omega, seed, timing, slots, out, n
            )
            n, b = _live(pixels, column, lo, hi, t_us, light, omega, seed, timing, slots, out, n)
            earliest = min(earliest, min(a, b))
        else:
            n, a = _live(
                pixels, column, first, last, t_us, light, omega, seed, timing, slots, out, n
            )
            earliest = min(earliest, a)
        if due[column] == np.inf:
            spans[column, 2], spans[column, 3] = first, last
        else:
            spans[column, 2] = min(spans[column, 2], first)
            spans[column, 3] = max(spans[column, 3], last)
        due[column] = earliest
        spans[column, 0], spans[column, 1] = lo, hi
    return columns.size, n


@njit(cache=True, nogil=True, error_model="numpy")
def _run_columns(pixels, spans, due, begin, until_us, optics, seed, timing, slots, out, n):
    """Everything that is due up to ``until_us`` in the columns from ``begin`` on.

    Stops where the output might not suffice; returns the next column and the number of events.
    """
    omega = optics[3]
    unchanged = np.empty(0)
    for column in range(begin, pixels.shape[0]):
        if due[column] > until_us:
            continue
        lo, hi = spans[column, 2], spans[column, 3]
        if out.size - n < (hi - lo) * optics[4]:
            return column, n
        n, due[column] = _live(
            pixels, column, lo, hi, until_us, unchanged, omega, seed, timing, slots, out, n
        )
    return pixels.shape[0], n


@njit(cache=True, nogil=True, error_model="numpy")
def _background(process, rate_per_us, until_us, columns, rows, seed, slots, out, n):
    """Poisson events over the whole sensor; ``process`` = time of the next one, count so far.

    Stops at a full output; returns the number of events.
    """
    while process[0] <= until_us and n < out.size:
        count = np.uint64(process[1])
        bits = _mix(np.uint64(seed) ^ (np.uint64(2) * count))
        place = np.int64((bits >> np.uint64(1)) % np.uint64(columns * rows))
        polarity = np.int64(bits & np.uint64(1))
        out[np.uintp(n)] = _readout_key(
            process[0], place % columns, place // columns, polarity, slots
        )
        n += 1
        draw = _mix(np.uint64(seed) ^ (np.uint64(2) * count + np.uint64(1)))
        uniform = (np.float64(draw >> np.uint64(11)) + 0.5) * 2.0**-53
        process[0] -= math.log(uniform) / rate_per_us
        process[1] += 1.0
    return n
