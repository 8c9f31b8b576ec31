"""The modulation's phase from the events that it causes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import integer_vector, ordered_times
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.modulation.fullest_rows import fullest_rows
from eschorty_ros.core.modulation.held_events import Arrays
from eschorty_ros.core.modulation.modulation import Modulation

_WINDOW_PERIODS = 4
_WINDOW_EVENTS = 2048
_HISTOGRAM_BINS = 200
# A readout that takes one row after the other may leave this long without an event in a burst, and
# at most this many bins are taken as such: noise fills some.
_ROW_US = 3.0
_GAP_BINS_MAX = 3
# Strength squared times the events: exponential with mean 1 where they are not modulated.
_RAYLEIGH_MIN = 30.0


@dataclass(frozen=True, slots=True)
class PhaseEstimate:
    """A rising edge found in a window of events."""

    edge_us: int
    """Sensor time of a rising edge within the window's first period, from the earliest events after
    it: late by the pixels' shortest latency. The first event's where none is ``found``."""
    strength: float
    """Vector strength of all events, 0 to 1 (ON events against the rising edge, OFF events against
    the falling one)."""
    found: bool
    """True when the window is modulated by the Rayleigh test."""


def estimate_phase(
    t_us: NDArray[np.int64],
    polarity: NDArray[np.uint8],
    modulation: Modulation,
    weights: NDArray[np.float64] | None = None,
) -> PhaseEstimate:
    """Return a rising edge from a window of events, by circular statistics at the known frequency.

    ON events follow the rising edge and OFF events the falling one, so the phase of OFF events is
    reduced by the duty cycle and both have one mean direction. The edge is where the burst begins:
    where the counts rise above the background.

    - ``t_us``: Shape (n,), in time order.
    - ``polarity``: Shape (n,), 1 for ON.
    - ``modulation``: ``on_edge_us`` is not used.
    - ``weights``: Shape (n,), all 1 when omitted; negative ones take off background.

    Raises ``ArgumentError`` when there are no events, or they are not in time order.
    """
    t_us = ordered_times("t_us", t_us)
    polarity = integer_vector("polarity", polarity, np.uint8, 0, 1)
    if t_us.size == 0 or t_us.shape != polarity.shape:
        raise ArgumentError(
            f"t_us has {t_us.size} events and polarity {polarity.size}; give one polarity per event"
        )
    period_us = modulation.period_us
    origin = int(t_us[0])
    phase = (t_us - origin) / period_us
    phase -= modulation.duty * (polarity == 0)
    phase -= np.floor(phase)
    if weights is None:
        weights = np.ones(t_us.size)
    angle = 2.0 * np.pi * phase
    # Faster than a complex exponential.
    vector = math.hypot(weights @ np.cos(angle), weights @ np.sin(angle))
    strength = min(float(vector / max(weights.sum(), 1.0)), 1.0)
    found = bool(vector * vector > _RAYLEIGH_MIN * (weights @ weights))
    gap_bins = min(math.ceil(_ROW_US * _HISTOGRAM_BINS / period_us), _GAP_BINS_MAX)
    begin = _burst_begin(phase, weights, gap_bins) if found else 0.0
    return PhaseEstimate(origin + round(begin * period_us), strength, found)


def line_phase(events: Arrays, modulation: Modulation) -> PhaseEstimate:
    """Return a rising edge from the events of lines, without what a lamp adds to them.

    - ``events``: Times, columns, rows and polarities of shape (n,), in time order.
    """
    t_us, column, row, polarity = events
    return estimate_phase(t_us, polarity, modulation, fullest_rows(column, row).weights)


def _burst_begin(phase: NDArray[np.float64], weights: NDArray[np.float64], gap_bins: int) -> float:
    """Return the phase, 0 to 1, at which the largest burst rises above the background.

    It may be as low for less than ``gap_bins``.
    """
    bins = np.minimum((phase * _HISTOGRAM_BINS).astype(np.int64), _HISTOGRAM_BINS - 1)
    counts = np.bincount(bins, weights, _HISTOGRAM_BINS)
    smooth = counts + np.roll(counts, 1) + np.roll(counts, -1)
    # A burst may be in one bin: those beside it have as large sums, and only background.
    around = (int(np.argmax(smooth)) + np.arange(-1, 2)) % _HISTOGRAM_BINS
    peak = int(around[np.argmax(counts[around])])
    background = float(np.quantile(counts, 0.2))
    level = background + 0.05 * (float(counts[around].mean()) - background)
    begin = peak
    for back in range(1, _HISTOGRAM_BINS // 2):
        before = (peak - back - np.arange(gap_bins)) % _HISTOGRAM_BINS
        if counts[before].mean() <= level:
            break
        if counts[before[0]] > level:
            begin = peak - back
    return (begin % _HISTOGRAM_BINS) / _HISTOGRAM_BINS


class Window(NamedTuple):
    """Leading events of a stream for one estimate."""

    size: int
    end_us: int


def estimation_window(
    t_us: NDArray[np.int64], watermark_us: int, modulation: Modulation
) -> Window | None:
    """Return the first estimation window of ``t_us``, ``None`` while it is still open.

    A window begins at the first event; it is the least multiple of ``_WINDOW_PERIODS`` periods with
    ``_WINDOW_EVENTS`` events. It depends on the events alone, not on the time of their arrival.
    """
    if t_us.size < _WINDOW_EVENTS:
        return None
    span_us = _WINDOW_PERIODS * modulation.period_us
    first = int(t_us[0])
    pieces = int((int(t_us[_WINDOW_EVENTS - 1]) - first) / span_us) + 1
    end_us = first + round(pieces * span_us)
    if watermark_us <= end_us:
        return None
    return Window(int(np.searchsorted(t_us, end_us)), end_us)
