"""A resting laser line on independent columns: the test bench of the pixel model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixels import PixelArray, PixelParameters, unpack
from eschorty_ros.simulation.world.timeline import LaserTimeline


@dataclass(frozen=True, slots=True, eq=False)
class LineEvents:
    """Events of :func:`simulate_line`, ordered by time, shape (n,)."""

    t: NDArray[np.int64]
    """Microseconds."""
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    """Column and row."""
    p: NDArray[np.uint8]
    """1 for ON, 0 for OFF."""
    truth_row: NDArray[np.float64]
    """Row of the line's centre, shape (columns,)."""

    def __len__(self) -> int:
        return self.t.size


def simulate_line(
    parameters: PixelParameters,
    modulation: Modulation,
    duration_us: int,
    *,
    columns: int = 64,
    line_row: ArrayLike = 360.0,
    reflectance: ArrayLike = 1.0,
    edge_offset_rows: ArrayLike | None = None,
    reflectance_above: ArrayLike | None = None,
    background_hz: float = 0.0,
    seed: int = 0,
    rows: int = 720,
) -> LineEvents:
    """Return the events of a resting line; no two columns share noise or thresholds.

    The line is dark before time 0. ``line_row``, ``edge_offset_rows`` and reflectances are one
    number or of shape (columns,).

    - ``modulation``: ``on_edge_us`` left out means a rising edge at 0.
    - ``columns``: Independent repetitions, at most 2048.
    - ``line_row``: Row of the line's centre.
    - ``reflectance``, ``reflectance_above``: 0 to 1; the latter given if and only if
      ``edge_offset_rows`` is.
    - ``edge_offset_rows``: Position of a reflectance step in the footprint: rows more than this
      above ``line_row`` (at higher row numbers) have ``reflectance_above``. The row of the edge has
      a mixture.
    - ``background_hz``: Background events per pixel and second.
    - ``seed``: Same seed, same events.
    - ``rows``: Height of the sensor, at most 1024.

    Raises ``ArgumentError`` for a value outside its range.
    """
    if not duration_us > 0:
        raise ArgumentError(f"duration_us is {duration_us!r}; choose a positive time")
    if (edge_offset_rows is None) != (reflectance_above is None):
        raise ArgumentError(
            f"edge_offset_rows is {edge_offset_rows!r} and reflectance_above "
            f"{reflectance_above!r}; give both or neither"
        )
    pixels = PixelArray(columns, rows, parameters, seed, background_hz)
    centre = _per_column("line_row", line_row, columns)
    bright = _per_column("reflectance", reflectance, columns)[:, np.newaxis]
    low = high = None
    if edge_offset_rows is not None and reflectance_above is not None:
        above = _per_column("reflectance_above", reflectance_above, columns)
        edge = centre + _per_column("edge_offset_rows", edge_offset_rows, columns)
        bright = np.column_stack((bright, above))
        low = np.column_stack((np.full(columns, -np.inf), edge))
        high = np.column_stack((edge, np.full(columns, np.inf)))
    line = np.repeat(centre[:, np.newaxis], bright.shape[1], axis=1)
    laser = LaserTimeline()
    laser.set(0, True, replace(modulation, on_edge_us=modulation.on_edge_us or 0))
    every = np.arange(columns)
    t_us: int | None = 0
    while t_us is not None and t_us < duration_us:
        pixels.relight(t_us, every, line, bright * laser.level(t_us), low, high)
        t_us = laser.next_us(t_us)
    pixels.run_until(duration_us)
    t, x, y, p = unpack(pixels.take(duration_us))
    return LineEvents(t, x, y, p, centre)


def _per_column(name: str, values: ArrayLike, columns: int) -> NDArray[np.float64]:
    """Return ``values`` as one finite number per column."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape not in ((), (columns,)) or not np.isfinite(array).all():
        raise ArgumentError(
            f"{name} has shape {array.shape}; give one finite number, or one for each of the "
            f"{columns} columns"
        )
    return np.array(np.broadcast_to(array, (columns,)))
