"""A second camera, with nothing in common with `eschorty_ros.simulation`, and its hard cases.

A pixel sees a flat-topped line with tails, has thresholds of its own (log-normal, ON and OFF
apart) and gives one event per threshold of the swing of the logarithmic intensity. Dim pixels are
late. Nothing is remembered from one laser edge to the next.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Encoder, sort_readout

COLUMNS, ROWS = 1280, 720
FIRST_EDGE_US = 1000
REACH = 28

Events = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]


@dataclass
class Camera:
    """One camera and laser; ``contrast`` is the line's peak over the ambient light."""

    frequency_hz: float = 70.0
    periods: int = 30
    seed: int = 5
    contrast: float = 6.0
    half_width_px: float = 5.5
    threshold: float = 0.9
    mismatch: float = 0.12
    events_max: int = 3
    delay_us: float = 60.0
    jitter_us: float = 35.0
    duty: float = 0.5
    thresholds: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        spread = self.mismatch * self.rng.standard_normal((2, ROWS, COLUMNS))
        self.thresholds = self.threshold * np.exp(spread)

    @property
    def period_us(self) -> float:
        return 1e6 / self.frequency_hz

    @property
    def end_us(self) -> float:
        return FIRST_EDGE_US + self.periods * self.period_us

    def light(self, distance_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the line's intensity at a distance from its centre, 1 at the peak."""
        u = np.abs(distance_px) / self.half_width_px
        return 0.97 * np.exp(-0.693 * u**3) + 0.03 / (1.0 + u * u)

    def line(
        self,
        row: Callable[[int, NDArray[Any]], NDArray[Any]],
        power: float | NDArray[np.float64] = 1.0,
        part: Callable[[int, NDArray[Any]], tuple[Any, Any]] = lambda _, __: (-ROWS, ROWS),
    ) -> Events:
        """Return the events of a line at ``row(period, columns)``; NaN is dark.

        ``power`` is that of all columns or of each. Only the ``part(period, columns)`` of its
        thickness, rows from its centre, falls on this surface.
        """
        column = np.arange(COLUMNS)
        power = np.broadcast_to(power, column.shape)
        reach = max(REACH, round(2.4 * self.half_width_px))
        offset = np.arange(-reach, reach + 1)[:, None]
        parts: list[Events] = []
        for k in range(self.periods):
            true_row = np.broadcast_to(np.asarray(row(k, column), float), column.shape)
            (lit,) = np.nonzero(np.isfinite(true_row))
            y = np.rint(true_row[lit]).astype(int) + offset
            y, x, away = np.broadcast_arrays(y, lit, y - true_row[lit])
            seen = (y >= 0) & (y < ROWS)
            y, x, away = y[seen], x[seen], away[seen]
            low, high = part(k, x)
            # Beyond that is less light than passes any pixel's threshold.
            near = np.abs(away) < 2.4 * self.half_width_px
            (lit,) = np.nonzero(near & (away >= low) & (away < high))
            brighter = self.contrast * power[x[lit]] * self.light(away[lit])
            swing = np.log1p(brighter)
            able = swing > 0.25 * self.threshold
            lit, brighter, swing = lit[able], brighter[able], swing[able]
            y, x = y[lit], x[lit]
            first_us = self.delay_us * (1.0 + 2.0 / np.maximum(brighter, 0.2))
            for polarity in (1, 0):
                noise = self.rng.standard_normal(seen.sum())[lit]
                wanted = swing * (1.0 + 0.05 * noise)
                count = (wanted / self.thresholds[1 - polarity, y, x]).astype(int)
                count = np.minimum(count, self.events_max)
                of = np.repeat(np.arange(count.size), count)
                nth = np.arange(of.size) - (np.cumsum(count) - count)[of]
                late = first_us[of] * (1.0 + 0.6 * nth)
                late += self.jitter_us * np.abs(self.rng.standard_normal(nth.size))
                start = FIRST_EDGE_US + (k + (0.0 if polarity else self.duty)) * self.period_us
                t = np.rint(start + late).astype(np.int64)
                which = np.full(t.size, polarity, np.uint8)
                parts.append((t, x[of].astype(np.uint16), y[of].astype(np.uint16), which))
        return joined(parts)

    def moving_line(self, row: Callable[[int, NDArray[Any]], NDArray[Any]], way_px: int) -> Events:
        """Return the events of a line that moves from ``row`` by ``way_px`` while it is lit.

        Two as the line reaches a pixel and two as it leaves it, or at the laser's edges.
        """
        half_px = round(self.half_width_px)
        offset, column = np.meshgrid(
            np.repeat(np.arange(-half_px, half_px + way_px + 1), 2), np.arange(COLUMNS)
        )
        parts: list[Events] = []
        for k in range(self.periods):
            y = np.rint(row(k, column)).astype(int) + offset
            for polarity, side in ((1, -half_px), (0, half_px)):
                lit = np.clip((offset + side) / way_px, 0.0, 1.0)
                late = self.delay_us + self.jitter_us * np.abs(self.rng.standard_normal(y.shape))
                start = FIRST_EDGE_US + (k + self.duty * lit) * self.period_us
                t = np.rint(start + late).astype(np.int64)
                parts.append((t.ravel(), column.ravel(), y.ravel(), np.full(t.size, polarity)))
        return joined(parts)

    def scattered(self, events_per_s: float) -> Events:
        """Return background: any pixel at any time."""
        seconds = (self.end_us - FIRST_EDGE_US) * 1e-6
        return self._uniform(
            round(events_per_s * seconds),
            lambda n: (self.rng.integers(0, COLUMNS, n), self.rng.integers(0, ROWS, n)),
            FIRST_EDGE_US,
            self.end_us,
        )

    def flickering(self, hz: float, events: float, columns: int) -> Events:
        """Return the events of a lamp on all pixels of the first ``columns``.

        A pixel has this many ``events`` of each polarity per cycle, on average.
        """
        cycles = int((self.end_us - FIRST_EDGE_US) * 1e-6 * hz)
        each = int(events * columns * ROWS * cycles)
        parts = []
        for polarity in (1, 0):
            phase = self.rng.integers(0, cycles, each) + self.rng.normal(
                0.25 if polarity else 0.75, 0.08, each
            )
            t = FIRST_EDGE_US + np.rint(np.maximum(phase, 0.0) * 1e6 / hz).astype(np.int64)
            x, y = (self.rng.integers(0, n, each).astype(np.uint16) for n in (columns, ROWS))
            parts.append((t, x, y, np.full(each, polarity, np.uint8)))
        return joined(parts)

    def hot_pixels(self, pixels: int, rate_hz: float) -> Events:
        """Return the events of pixels that fire all the time."""
        x, y = self.rng.integers(0, COLUMNS, pixels), self.rng.integers(0, ROWS, pixels)
        count = round(pixels * rate_hz * (self.end_us - FIRST_EDGE_US) * 1e-6)

        def place(n: int) -> tuple[NDArray[Any], NDArray[Any]]:
            which = self.rng.integers(0, pixels, n)
            return x[which], y[which]

        return self._uniform(count, place, FIRST_EDGE_US, self.end_us)

    def firing_row(self, row: int, begin_us: float, length_us: float, rate_hz: float) -> Events:
        """Return the events of one complete row that fires for a while."""
        count = round(COLUMNS * rate_hz * length_us * 1e-6)
        return self._uniform(
            count,
            lambda n: (self.rng.integers(0, COLUMNS, n), np.full(n, row)),
            begin_us,
            begin_us + length_us,
        )

    def moving_object(self, events_per_s: float) -> Events:
        """Return the events of a slanted edge that crosses the sensor and does not blink."""
        span_us = self.end_us - FIRST_EDGE_US
        n = round(events_per_s * span_us * 1e-6)
        t = FIRST_EDGE_US + span_us * self.rng.random(n)
        x = self.rng.integers(0, COLUMNS, n)
        at = 60.0 + 500.0 * (t - FIRST_EDGE_US) / span_us + 0.05 * x
        y = np.clip(np.rint(at + self.rng.normal(0.0, 2.0, n)), 0, ROWS - 1)
        return np.rint(t).astype(np.int64), x, y.astype(int), (self.rng.random(n) < 0.8).astype(int)

    def _uniform(self, n: int, place: Any, begin_us: float, end_us: float) -> Events:
        t = np.rint(begin_us + (end_us - begin_us) * self.rng.random(n)).astype(np.int64)
        x, y = place(n)
        return t, x, y, self.rng.integers(0, 2, n)


def joined(parts: list[Events]) -> Events:
    t, x, y, p = (np.concatenate(values) for values in zip(*parts, strict=True))
    return t, x, y, p


def stream(*parts: Events) -> bytes:
    """Return the EVT3 bytes of all events in the order of the sensor's readout."""
    return Encoder().encode(*sort_readout(*joined(list(parts))))


def wavy(k: int, column: NDArray[Any]) -> NDArray[np.float64]:
    """Return a smooth surface that passes every phase of the pixel grid."""
    return 350.0 + 12.0 * np.sin(column / 160.0) + 0.13 * k
