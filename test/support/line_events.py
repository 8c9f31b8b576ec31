"""Laser lines as event streams with known rows, for the tests of the reconstruction."""

from collections.abc import Callable
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Encoder, sort_readout
from eschorty_ros.core.reconstruction import Profiles

Rows = Callable[[int, NDArray[np.int64]], NDArray[np.float64]]


def line_events(
    rng: np.random.Generator,
    rows: Rows,
    *,
    frequency_hz: float = 70.0,
    periods: int = 10,
    columns: int = 1280,
    events: float = 22.0,
    fwhm_px: float = 20.0,
    background: float = 0.05,
    edge_us: int = 1000,
    latency_us: float = 200.0,
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Return independent events: half after the rising edge, half after the falling one, Gaussian.

    ``rows(period, columns)`` gives the true row, NaN where a column is dark.
    """
    period_us = 1e6 / frequency_hz
    column = np.arange(columns)
    parts = []
    for k in range(periods):
        true_row = np.broadcast_to(rows(k, column), column.shape)
        lit = np.isfinite(true_row)
        for polarity in (1, 0):
            count = rng.poisson(events * (1 - background) / 2, columns) * lit
            x = np.repeat(column, count)
            y = rng.normal(np.repeat(true_row, count), fwhm_px / 2.3548)
            delay = rng.gamma(2.0, min(latency_us, period_us / 8) / 2, x.size)
            start = edge_us + (k + (0.0 if polarity else 0.5)) * period_us
            parts.append((start + delay, x, y, np.full(x.size, polarity)))
        n = rng.poisson(events * background * columns)
        start = edge_us + (k + rng.random(n)) * period_us
        x, y = rng.integers(0, columns, n), rng.uniform(-0.5, 719.5, n)
        parts.append((start, x, y, rng.integers(0, 2, n)))
    t, x, y, p = (np.concatenate(values) for values in zip(*parts, strict=True))
    inside = (y > -0.5) & (y < 719.5)
    return sort_readout(
        np.rint(t[inside]).astype(np.int64),
        x[inside].astype(np.uint16),
        np.rint(y[inside]).astype(np.uint16),
        p[inside].astype(np.uint8),
    )


def encoded(
    events: tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]],
    triggers_us: NDArray[np.int64] | None = None,
) -> bytes:
    """Return the EVT3 bytes of the events, with rising trigger edges when given."""
    if triggers_us is None:
        return Encoder().encode(*events)
    rising = np.ones(len(triggers_us), np.uint8)
    return Encoder().encode(*events, trigger_t=triggers_us, trigger_edge=rising)


def blank_profiles(size: int, **values: NDArray[np.generic]) -> Profiles:
    """Return points whose fields are 0 unless given."""
    blank = Profiles.empty()
    kinds = {item.name: getattr(blank, item.name) for item in fields(Profiles)}
    zeros = {name: np.zeros(size, kind.dtype) for name, kind in kinds.items() if kind is not None}
    return Profiles(**{**zeros, **values})
