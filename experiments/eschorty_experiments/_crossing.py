"""A reflectance step that crosses the laser line, profile by profile."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_experiments._line_bench import simulate_line
from eschorty_ros.core.evt3 import Encoder, sort_readout
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, load_calibration
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings
from eschorty_ros.simulation.pixels import PixelParameters

RANGE_MM = 1320.0
SPEED_MM_S = 300.0
BOARD = 0.8
"""Reflectance of the board around the step: without any lit column there is no profile."""

BOARD_COLUMNS = 16
_SETTLING_PERIODS = 2
_COLUMNS_MAX = 2048
_FAR_ROWS = 200.0


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """Simulated stream of a flat target with a step, and its truth."""

    data: bytes
    """EVT3, rising edges at multiples of the period."""
    modulation: Modulation
    calibration: Calibration
    """Of a sensor with as many columns as were simulated."""
    line_row: NDArray[np.float64]
    """Row of the line's centre, shape (columns,)."""
    offset_rows: NDArray[np.float64]
    """Position of the step: rows above the line's centre, shape (profiles, columns)."""
    target: NDArray[np.bool_]
    """Columns on the step, shape (columns,); the others are on the uniform board."""

    def reconstruct(self, **settings: float | str) -> tuple[Profiles, dict[str, int]]:
        """Return points and counters of the stream, reconstructed with ``settings``."""
        chosen = Settings(**{"stage_speed_mm_s": SPEED_MM_S, **settings})  # type: ignore[arg-type]
        reconstructor = Reconstructor(self.calibration, self.modulation, chosen)
        found = Profiles.concatenate([reconstructor.push(self.data), reconstructor.flush()])
        return found, reconstructor.counters


def rows_per_profile(frequency_hz: float) -> float:
    """Return the rows that a step moves from one period to the next."""
    model = load_calibration("config_3").model()
    return float(model.rows_per_mm_off_sheet(RANGE_MM)) * SPEED_MM_S / frequency_hz


def crossing(
    parameters: PixelParameters,
    frequency_hz: float,
    before: ArrayLike,
    after: ArrayLike,
    *,
    columns: int,
    margin_rows: float = 36.0,
    slanted: bool = False,
    background_hz: float = 0.0,
    seed: int = 0,
) -> Crossing:
    """Simulate a step between two reflectances that crosses the line.

    The stage moves towards +y, so the surface ahead is below the line's centre (at lower rows).
    Every profile is simulated at rest with the step at its position then, on pixels of its own.

    - ``before``, ``after``: Reflectance of the first surface and of the one that follows, one or
      shape (columns,).
    - ``columns``: Columns on the step; ``BOARD_COLUMNS`` more are on the board.
    - ``margin_rows``: Distance from the line's centre at which the step begins and ends.
    - ``slanted``: Spread the step's position over the columns by its displacement between profiles;
      otherwise it is at the centre of all columns at once in the middle profile.
    """
    step = rows_per_profile(frequency_hz)
    reach = int(np.ceil(margin_rows / step)) + 1
    rng = np.random.default_rng(seed)
    full = columns + BOARD_COLUMNS
    calibration = replace(load_calibration("config_3"), columns=full)
    line_row = float(calibration.model().row(RANGE_MM)) + rng.random(full)
    slant = np.arange(full) / columns * step if slanted else np.zeros(full)
    offsets = np.arange(-reach, reach + 1)[:, None] * step + slant
    target = np.arange(full) < columns
    old = np.concatenate((np.broadcast_to(before, columns), np.full(BOARD_COLUMNS, BOARD)))
    new = np.concatenate((np.broadcast_to(after, columns), np.full(BOARD_COLUMNS, BOARD)))
    modulation = Modulation(frequency_hz, on_edge_us=0)
    at_once = _COLUMNS_MAX // full
    parts = []
    for first in range(0, len(offsets), at_once):
        some = offsets[first : first + at_once]
        line = simulate_line(
            parameters,
            modulation,
            modulation.edge_us(_SETTLING_PERIODS + 1),
            columns=some.size,
            line_row=np.tile(line_row, len(some)),
            reflectance=np.tile(new, len(some)),
            edge_offset_rows=np.clip(some, -_FAR_ROWS, _FAR_ROWS).ravel(),
            reflectance_above=np.tile(old, len(some)),
            background_hz=background_hz,
            seed=seed + first,
        )
        settled_us = modulation.edge_us(_SETTLING_PERIODS)
        kept = line.t >= settled_us
        profile, column = np.divmod(line.x[kept].astype(np.int64), full)
        edges_us = np.array([modulation.edge_us(first + k) for k in range(len(some))])
        t_us = line.t[kept] - settled_us + edges_us[profile]
        parts.append((t_us, column.astype(np.uint16), line.y[kept], line.p[kept]))
    t, x, y, p = (np.concatenate(values) for values in zip(*parts, strict=True))
    order = np.argsort(t, kind="stable")
    data = Encoder(full, calibration.rows).encode(
        *sort_readout(t[order], x[order], y[order], p[order])
    )
    return Crossing(data, modulation, calibration, line_row, offsets, target)
