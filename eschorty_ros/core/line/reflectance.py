"""Relative reflectance of a point from the width of its line and the number of its events.

The pixels of a logarithmic sensor fire where the contrast of the Gaussian footprint exceeds their
threshold, so the full width W of the lit rows obeys
``W^2 = 8 sigma^2 ln(A rho / (e^theta - 1))``: linear in ``ln rho`` with a slope that depends on the
optical footprint's sigma alone. At high frequencies, where the photoreceptor's bandwidth limits the
swing, the offset changes and the slope does not. Evenly lit rows have the variance ``W^2 / 12`` and
a number of events proportional to W; the smaller W of the two is used. Above about 1 kHz a row has
an event in some periods only and neither relation holds.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array, integer_vector, vector
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, number

ROOT_12 = math.sqrt(12.0)
"""Full width over standard deviation of evenly spread rows."""

# Standard deviation of ln(rho) due to the mismatch of the pixels' thresholds, whatever the number
# of events; due to comparator noise in each row's few events; and, in px, due to the quantisation
# to rows at the two ends of the line.
_FIXED = 0.11
_PER_EVENT = 0.18
_ENDS_PX = math.sqrt(2.0 / 12.0)
# No two surfaces differ by more than a factor of 1000, a retroreflector and black velvet included.
_LOG_MAX = math.log(1e3)


def events_per_row(width_px: Array, events: NDArray[np.integer]) -> float:
    """Return the events of one lit row: the median over the points of events over full width.

    NaN without a usable point.
    """
    width_px, counts = _checked(width_px, events)
    usable = width_px > 0.0
    if not usable.any():
        return math.nan
    return float(np.median(counts[usable] / (ROOT_12 * width_px[usable])))


def relative_reflectance(
    edge_us: NDArray[np.int64],
    width_px: Array,
    events: NDArray[np.integer],
    footprint_sigma_px: float,
    white_width_px: float = 0.0,
) -> tuple[Array, Array]:
    """Return the reflectance of each point relative to its profile's median or a white target.

    The second array is the standard deviation of one point, without that of the reference. Both
    have shape (n,), NaN where the reflectance is more than a factor of 1000 off: the width is then
    that of background.

    - ``edge_us``: One entry per point, shape (n,), like ``width_px`` and ``events``. Points of one
      profile share a value and follow each other.
    - ``width_px``: Sample standard deviation of the rows used.
    - ``events``: Events used.
    - ``footprint_sigma_px``: Standard deviation of the laser line's intensity over the rows.
    - ``white_width_px``: Median ``width_px`` of a white target's points; 0 for the profile's own
      median.

    Raises ``ArgumentError`` when shapes differ, ``footprint_sigma_px`` is not within 0.1 to 1000 px
    or ``white_width_px`` not within 0 to 1000 px.
    """
    edge_us = integer_vector("edge_us", edge_us, np.int64, -TIME_LIMIT, TIME_LIMIT)
    width_px, counts = _checked(width_px, events)
    if edge_us.shape != width_px.shape:
        raise ArgumentError(
            f"edge_us has {edge_us.size} entries and width_px {width_px.size}; give equal numbers"
        )
    number("footprint_sigma_px", footprint_sigma_px, 0.1, 1e3)
    number("white_width_px", white_width_px, 0.0, 1e3)
    # Full width squared per e-fold of reflectance.
    slope = 8.0 * footprint_sigma_px * footprint_sigma_px
    width2 = np.empty(edge_us.size)
    reference2 = np.full(edge_us.size, 12.0 * white_width_px * white_width_px)
    variance = np.full(edge_us.size, _FIXED * _FIXED)
    starts = np.flatnonzero(np.diff(edge_us, prepend=~edge_us[:1]))
    for begin, end in pairwise([*starts.tolist(), edge_us.size]):
        part = slice(begin, end)
        per_row = events_per_row(width_px[part], counts[part])
        width2[part] = 12.0 * width_px[part] * width_px[part]
        if not math.isnan(per_row):
            # Background mainly increases the spread, a refractory time mainly reduces the counts.
            width2[part] = np.minimum(width2[part], np.square(counts[part] / per_row))
            variance[part] += (_PER_EVENT / per_row) ** 2
        if white_width_px == 0.0:
            reference2[part] = np.median(width2[part])
    log_ratio = (width2 - reference2) / slope
    log_ratio[np.abs(log_ratio) > _LOG_MAX] = np.nan
    reflectance = np.exp(log_ratio)
    variance += 4.0 * width2 * (_ENDS_PX / slope) ** 2
    return reflectance, reflectance * np.sqrt(variance)


def _checked(width_px: Array, events: NDArray[np.integer]) -> tuple[Array, NDArray[np.int64]]:
    widths = vector("width_px", width_px)
    if (widths < 0.0).any():
        raise ArgumentError(f"width_px is {widths.min()}; choose 0 or more")
    counts = integer_vector("events", events, np.int64, 0, TIME_LIMIT)
    if counts.size != widths.size:
        raise ArgumentError(
            f"width_px has {widths.size} entries and events {counts.size}; give equal numbers"
        )
    return widths, counts
