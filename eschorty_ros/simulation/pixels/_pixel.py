"""Event-driven pixels: each one is touched when its light changes or its own event is due.

A pixel is anchored at ``t``, the time its light last changed or its refractory period ended;
nothing else moves the anchor and every draw is a hash of pixel and time, so that looking at a
pixel in between does not change what it does.
"""

from __future__ import annotations

import math

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.simulation.pixels._draw import _bits, _gaussian, _mix, _uniform
from eschorty_ros.simulation.pixels._light import _add_patch, _window
from eschorty_ros.simulation.pixels._passage import GAP_MAX, _noisy
from eschorty_ros.simulation.pixels._prompt import _prompt
from eschorty_ros.simulation.pixels._response import (
    NOTHING,
    UNKNOWN,
    _advanced,
    _earliest_us,
    _fade,
    _noiseless,
)

PIXEL_DTYPE = np.dtype(
    [
        ("u", "f8"),  # photoreceptor at the anchor
        ("y", "f8"),  # source follower at the anchor
        ("y_ref", "f8"),  # comparator reference at the anchor
        ("u_settled", "f8"),  # 1 / I: where both are heading
        ("t", "f8"),  # anchor, us
        ("t_next", "f8"),  # when something is due, us; what is told by state
        ("on_factor", "f4"),  # exp(-theta_on)
        ("off_factor", "f4"),  # exp(theta_off)
        ("state", "i8"),
    ],
    align=True,
)

# States: OFF and ON = an event at t_next; WAITS = nothing before t_next; HELD = until t_next.
WAITS, HELD = 2, 3
_FULL = -1.0
_AT_REST = 0.1
"""Lag of y behind u that counts as none, standard deviations of the noise."""


@kernel
def _key(t_us, column, row, polarity):
    """Event as one sortable integer: whole microsecond from ``t_us`` on, row, polarity, column."""
    return (np.int64(np.ceil(t_us)) << 22) | (row << 12) | (polarity << 11) | column


@kernel
def _live(pixels, column, lo, hi, until_us, light, model, tables, seed, out, n):
    """Let rows [lo, hi) do what is due up to ``until_us``, then give them the light ``light``.

    An empty ``light`` leaves theirs as it is. ``model`` = omega0 (per us), follower (us), noise,
    refractory time (us) and its relative spread, latency and its spread (us). Returns the number
    of events in ``out`` and the earliest time something is due in these rows, ``_FULL`` when the
    output did not suffice: call again with more room.
    """
    omega, follower_us, noise = model[0], model[1], model[2]
    table = tables[0]
    reach = math.exp(GAP_MAX * noise)
    earliest = np.inf
    relit = light.size > 0
    for row in range(lo, hi):
        pixel = pixels[np.uintp(column), np.uintp(row)]
        t_next = pixel.t_next
        if t_next > until_us and not relit:
            earliest = min(earliest, t_next)
            continue
        # Locals: the compiler cannot know that ``out`` and the pixel do not overlap.
        u, y, settled, t, y_ref = pixel.u, pixel.y, pixel.u_settled, pixel.t, pixel.y_ref
        on_level = y_ref * np.float64(pixel.on_factor)
        off_level = y_ref * np.float64(pixel.off_factor)
        state = pixel.state
        tau_us = settled / omega
        full = False
        while t_next <= until_us:
            if state == WAITS:
                if noise > 0.0:
                    budget = -math.log(_uniform(_bits(t, column, row, seed, 1)))
                    after_us, what = _noisy(
                        u, y, settled, tau_us, follower_us, on_level, off_level, y_ref, noise,
                        table, t_next - t, until_us - t, budget,
                    )  # fmt: skip
                else:
                    after_us, what = _noiseless(
                        u, y, settled, tau_us, follower_us, on_level, off_level
                    )
                if what == UNKNOWN:
                    break
                t_next = t + after_us
                if what != NOTHING:
                    state = what
            elif state == HELD:
                u, y = _advanced(u, y, settled, tau_us, follower_us, t_next - t)
                t = t_next
                y_ref = y
                if noise > 0.0:
                    y_ref *= _fade(noise * _gaussian(_bits(t, column, row, seed, 2)))
                on_level = y_ref * np.float64(pixel.on_factor)
                off_level = y_ref * np.float64(pixel.off_factor)
                state = WAITS
                t_next = _earliest_us(
                    u, y, settled, t, tau_us, follower_us, on_level, off_level, reach
                )
            else:
                if n == out.size:
                    full = True
                    break
                bits = _bits(t_next, column, row, seed, 3)
                late_us = max(1.0, model[5] + model[6] * _gaussian(bits))
                out[np.uintp(n)] = _key(t_next + late_us, column, row, state)
                n += 1
                state = HELD
                held_us = model[3]
                if model[4] > 0.0:
                    held_us *= max(0.0, 1.0 + model[4] * _gaussian(_mix(bits)))
                t_next += max(1.0, held_us)
        if relit and not full:
            u, y = _advanced(u, y, settled, tau_us, follower_us, until_us - t)
            t = until_us
            settled = 1.0 / light[np.uintp(row)]
            pixel.u_settled = settled
            if state != HELD:
                state = WAITS
                tau_us = settled / omega
                t_next = _earliest_us(
                    u, y, settled, t, tau_us, follower_us, on_level, off_level, reach
                )
        pixel.u = u
        pixel.y = y
        pixel.t = t
        pixel.y_ref = y_ref
        pixel.state = state
        pixel.t_next = t_next
        if full:
            return n, _FULL
        earliest = min(earliest, t_next)
    return n, earliest


@kernel
def _foresee(pixels, column, lo, hi, model, tables, seed):
    """Look up the next event of the rows [lo, hi) just lit that set out from rest.

    A pass of its own, since without branches on what a pixel does the processor works at
    several pixels at once. Other rows are left to :func:`_live`.
    """
    omega, follower_us, noise = model[0], model[1], model[2]
    ways, gaps = tables[1], tables[2]
    for row in range(lo, hi):
        pixel = pixels[np.uintp(column), np.uintp(row)]
        u, t, settled, y_ref = pixel.u, pixel.t, pixel.u_settled, pixel.y_ref
        waits = pixel.state == WAITS and t < pixel.t_next < np.inf
        if not (waits and abs(u - pixel.y) < _AT_REST * noise * u):
            continue
        after_us, what = _prompt(
            u, settled, settled / omega, follower_us, y_ref * np.float64(pixel.on_factor),
            y_ref * np.float64(pixel.off_factor), noise, ways, gaps,
            _uniform(_bits(t, column, row, seed, 1)),
        )  # fmt: skip
        if what != UNKNOWN:
            pixel.state = what
            pixel.t_next = t + after_us


@kernel
def _relight(
    pixels, spans, due, columns, begin, patches, light, optics, model, tables, t_us, seed,
    out, n,
):  # fmt: skip
    """Put the footprint ``patches`` (columns, patches, 4) in ``columns[begin:]`` from ``t_us`` on.

    ``spans`` holds per column the lit rows [0, 1) and the rows with something pending [2, 3),
    ``due`` the earliest pending time. ``optics`` = sigma (rows), least contrast drawn, background.
    ``light`` is room for one column. Stops where the output does not suffice; returns the next
    column to do and the number of events.
    """
    sigma, background = optics[0], optics[2]
    rows = pixels.shape[1]
    for k in range(begin, columns.size):
        column = columns[k]
        lo, hi = rows, 0
        for j in range(patches.shape[1]):
            first, last = _window(patches[k, j], sigma, optics[1], rows)
            if last > first:
                lo, hi = min(lo, first), max(hi, last)
        old_lo, old_hi = spans[column, 0], spans[column, 1]
        if hi <= lo:
            lo, hi = old_lo, old_lo
        light[old_lo:old_hi] = background
        light[lo:hi] = background
        for j in range(patches.shape[1]):
            first, last = _window(patches[k, j], sigma, optics[1], rows)
            _add_patch(light, first, last, patches[k, j], sigma)
        # One run over both spans, unless they lie apart: what is between stays untouched.
        first, last = (min(lo, old_lo), max(hi, old_hi)) if hi > lo else (old_lo, old_hi)
        apart = hi < old_lo or lo > old_hi
        if old_hi <= old_lo:
            first, last, apart = lo, hi, False
        n, earliest = _live(
            pixels, column, old_lo if apart else first, old_hi if apart else last, t_us, light,
            model, tables, seed, out, n,
        )  # fmt: skip
        if apart and earliest != _FULL:
            n, other = _live(pixels, column, lo, hi, t_us, light, model, tables, seed, out, n)
            earliest = min(earliest, other)
        if earliest == _FULL:
            return k, n
        if model[2] > 0.0:
            _foresee(pixels, column, lo, hi, model, tables, seed)
            if apart or old_lo < lo or old_hi > hi:
                _foresee(pixels, column, old_lo, old_hi, model, tables, seed)
        if due[column] == np.inf:
            spans[column, 2], spans[column, 3] = first, last
        else:
            spans[column, 2] = min(spans[column, 2], first)
            spans[column, 3] = max(spans[column, 3], last)
        due[column] = min(due[column], earliest)
        spans[column, 0], spans[column, 1] = lo, hi
    return columns.size, n


@kernel
def _trim(pixels, column, spans):
    """Leave out rows with nothing pending at both ends: a line that moved on is not revisited."""
    lo, hi = spans[column, 2], spans[column, 3]
    while lo < hi and pixels[np.uintp(column), np.uintp(lo)].t_next == np.inf:
        lo += 1
    while lo < hi and pixels[np.uintp(column), np.uintp(hi - 1)].t_next == np.inf:
        hi -= 1
    spans[column, 2], spans[column, 3] = lo, hi


@kernel
def _run_columns(pixels, spans, due, begin, until_us, model, tables, seed, out, n):
    """Everything that is due up to ``until_us`` in the columns from ``begin`` on.

    Stops where the output does not suffice; returns the next column and the number of events.
    """
    unchanged = np.empty(0)
    for column in range(begin, pixels.shape[0]):
        if due[column] > until_us:
            continue
        n, earliest = _live(
            pixels, column, spans[column, 2], spans[column, 3], until_us, unchanged, model, tables,
            seed, out, n,
        )  # fmt: skip
        if earliest == _FULL:
            return column, n
        due[column] = earliest
        _trim(pixels, column, spans)
    return pixels.shape[0], n


@kernel
def _background(process, per_us, shares, hot, until_us, columns, rows, seed, out, n):
    """Poisson events over the whole sensor; ``process`` = time of the next one, count so far.

    ``shares`` = those that are OFF, those of the pixels ``hot``. Stops at a full output; returns
    the number of events.
    """
    while process[0] <= until_us and n < out.size:
        count = np.uint64(process[1])
        bits = _mix(np.uint64(seed) ^ (np.uint64(2) * count))
        place = np.int64((bits >> np.uint64(24)) % np.uint64(columns * rows))
        polarity = np.int64(_uniform(_mix(bits)) >= shares[0])
        draw = _mix(np.uint64(seed) ^ (np.uint64(2) * count + np.uint64(1)))
        if hot.size and _uniform(_mix(draw)) < shares[1]:
            place = hot[place % hot.size]
        out[np.uintp(n)] = _key(process[0], place % columns, place // columns, polarity)
        n += 1
        process[0] -= math.log(_uniform(draw)) / per_us
        process[1] += 1.0
    return n
