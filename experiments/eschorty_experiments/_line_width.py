"""Events and width of a resting, modulated line: simulated and in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_experiments._line_bench import simulate_line
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixels import PixelParameters

ROWS, LINE_ROW = 81, 40.0
SETTLE_US = 20_000
_HALVINGS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """One frequency of one preset."""

    frequency_hz: float
    rate_hz: float
    """Events per second and column."""
    widths_px: NDArray[np.int64]
    """Full width at half maximum of each column, shape (columns,)."""
    rows_hz: NDArray[np.float64]
    """Events per second and column in each row, shape (ROWS,)."""

    @property
    def width_px(self) -> float:
        """Median width over the columns."""
        return float(np.median(self.widths_px))


def measure(
    parameters: PixelParameters, frequency_hz: float, columns: int, periods: int, seed: int
) -> Point:
    """Simulate a resting line and count its events over complete periods in the steady state."""
    modulation = Modulation(frequency_hz)
    settle = int(np.ceil(SETTLE_US / modulation.period_us))
    start_us = round(settle * modulation.period_us)
    stop_us = round((settle + periods) * modulation.period_us)
    # A line may be anywhere between the centres of two rows.
    line_row = LINE_ROW + np.random.default_rng(seed).uniform(-0.5, 0.5, columns)
    events = simulate_line(
        parameters, modulation, stop_us, columns=columns, rows=ROWS, line_row=line_row, seed=seed
    )
    settled = events.t >= start_us
    cell = events.x[settled].astype(np.int64) * ROWS + events.y[settled]
    counts = np.bincount(cell, minlength=columns * ROWS).reshape(columns, ROWS)
    per_second = 1e6 / (stop_us - start_us) / columns
    return Point(
        frequency_hz,
        float(counts.sum()) * per_second,
        np.array([full_width_half_maximum(column) for column in counts]),
        counts.sum(axis=0) * per_second,
    )


def swing(parameters: PixelParameters, frequency_hz: float, contrast: float) -> float:
    """Return the steady peak-to-peak log swing of a pixel under a square wave of duty 1/2.

    The photoreceptor's relative rate falls from ``u_dark`` to ``u_bright`` during each lit half and
    returns during the dark one; the source follower then attenuates as one pole. The swing is
    ``ln(u_dark / u_bright) / sqrt(1 + (f / f_sf)^2)``.

    - ``contrast``: Photocurrent the lit line adds at the pixel.
    """
    dark = parameters.background_intensity
    bright = dark + contrast
    rate = 2.0 * math.pi * parameters.bandwidth_hz / (2.0 * frequency_hz)
    a, c = math.exp(-rate * bright), math.exp(-rate * dark)
    u_bright = (1.0 - a) / bright + a * (1.0 - c) / dark
    u_dark = (1.0 - c) / dark + c * (1.0 - a) / bright
    pole = math.hypot(1.0, frequency_hz / parameters.follower_hz)
    return math.log(u_dark / u_bright) / pole


def closed_form_width(parameters: PixelParameters, frequency_hz: float) -> float:
    """Return the number of rows whose swing exceeds the threshold.

    Without noise and mismatch; 0 where no row does. At low frequency
    ``2 sigma sqrt(2 ln(A / (e^theta - 1)))``.
    """
    threshold = max(parameters.threshold_on, parameters.threshold_off)
    low, high = 0.0, parameters.amplitude
    if swing(parameters, frequency_hz, high) <= threshold:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if swing(parameters, frequency_hz, middle) > threshold:
            high = middle
        else:
            low = middle
    return 2.0 * parameters.sigma_rows * math.sqrt(2.0 * math.log(parameters.amplitude / high))


def full_width_half_maximum(counts: NDArray[np.integer]) -> int:
    """Return the rows from first to last bin with half of the three highest bins' mean or more.

    Both ends count; 0 without events. ``counts`` are the events per row, shape (rows,).
    """
    level = 0.5 * float(np.sort(counts)[-3:].mean())
    if level == 0.0:
        return 0
    reached = np.flatnonzero(counts >= level)
    return int(reached[-1] - reached[0] + 1)
