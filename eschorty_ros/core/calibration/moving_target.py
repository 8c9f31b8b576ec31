"""One target that the stage moves along the range: hundreds of known ranges in one sweep."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import reals
from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.base.numbers import integer, number
from eschorty_ros.core.calibration.post_finder import COLUMNS_MIN, GRID_SIGMA_PX
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.line import SIGMA_FLOOR_PX
from eschorty_ros.core.reconstruction import Profiles

# Standard deviation of a stage position by the encoder.
_SIGMA_STAGE_MM = 0.01
_NEAREST_MM = 1.0
_LIT_SHARE = 0.5
_OUTLIER_PX = 4.0
_PAIRED_MAX = 300
# The events of a moving line lag it by this much, with the opposite sign on the way back.
_LATE_PX = 0.1


class _Axis(NamedTuple):
    """How a target's range depends on the stage position."""

    range_at_zero_mm: float
    sigma_at_zero_mm: float
    range_per_stage: float


def moving_target(
    profiles: Profiles,
    stage_mm: ArrayLike,
    range_at_zero_mm: float,
    *,
    range_per_stage: float = 1.0,
    sigma_at_zero_mm: float = 0.0,
    blocks: int = 1,
) -> Targets:
    """Turn every profile of a moving flat target into a target of known range.

    The events of a line that moves over the pixels lag it by a fraction of a row, at any speed:
    join sweeps back and forth (``Targets.concatenate``), and the lag cancels.

    Targets come by time, then column, in the columns with points in half of the profiles; the
    label is the stage position in mm. Profiles more than 4 px off the line through the others, or
    with the target in few columns, are left out.

    - ``profiles``: Of the sweep; only the nearest return of a column is used.
    - ``stage_mm``: Shape (len(profiles),). Stage position at each point's time, as
      ``StageTrack.position_mm`` gives it; points with NaN are left out.
    - ``range_at_zero_mm``: Range of the target with the stage at 0. Its error shifts all targets
      alike, which no number of profiles reveals: ``sigma_at_zero_mm``, its standard deviation,
      becomes the targets' ``sigma_shared_mm``.
    - ``range_per_stage``: Range gained per stage travel: 1 when the stage moves the target away
      along the sheet, -1 towards the sensor, the cosine of the angle in between.
    - ``blocks``: Targets per profile, side by side: several determine how ``b'`` varies along the
      line.

    Raises ``ArgumentError`` when ``stage_mm`` has another length than the points, or a value is out
    of its range. Raises ``FitError`` when too few columns or profiles show a target.
    """
    position = reals("stage_mm", stage_mm)
    if position.shape != (len(profiles),):
        raise ArgumentError(
            f"stage_mm has shape {position.shape}; give one position for each of the "
            f"{len(profiles)} points"
        )
    number("range_at_zero_mm", range_at_zero_mm)
    if number("range_per_stage", range_per_stage, -1.0, 1.0) == 0.0:
        raise ArgumentError("range_per_stage is 0; the stage must change the target's range")
    number("sigma_at_zero_mm", sigma_at_zero_mm, 0.0)
    integer("blocks", blocks, 1, 64)
    used = np.isfinite(position) & np.isfinite(profiles.row) & (profiles.return_index == 0)
    profiles, position = profiles.select(used), position[used]
    low, high = _lit_columns(profiles)
    inside = (profiles.column >= low) & (profiles.column <= high)
    profiles, position = profiles.select(inside), position[inside]
    if high - low + 1 < COLUMNS_MIN * blocks:
        raise FitError(
            f"columns {low} to {high} are too few for {blocks} targets side by side; a target "
            f"takes {COLUMNS_MIN} columns"
        )
    block = (profiles.column.astype(np.int64) - low) * blocks // (high - low + 1)
    _, period = np.unique(profiles.edge_us, return_inverse=True)
    group = period * blocks + block
    axis = _Axis(range_at_zero_mm, sigma_at_zero_mm, range_per_stage)
    return _measured(profiles, position, group, blocks, axis)


def _lit_columns(profiles: Profiles) -> tuple[int, int]:
    """Return the first and last column with points in half of the profiles."""
    points = np.bincount(profiles.column)
    often = np.flatnonzero(points >= max(_LIT_SHARE * profiles.profile_count, 1.0))
    if not often.size:
        raise FitError("no column shows a target in half of the profiles; check laser and focus")
    return int(often[0]), int(often[-1])


def _measured(
    profiles: Profiles,
    position: NDArray[np.float64],
    group: NDArray[np.int64],
    blocks: int,
    axis: _Axis,
) -> Targets:
    """Return a target for each group of points with enough columns that agree."""
    order = np.lexsort((profiles.row, group))
    group, row, position = group[order], profiles.row[order], position[order]
    column = profiles.column[order].astype(np.float64)
    _, starts, sizes = np.unique(group, return_index=True, return_counts=True)
    middle = row[starts + sizes // 2]
    agree = np.abs(row - np.repeat(middle, sizes)) <= _OUTLIER_PX
    count = np.add.reduceat(agree, starts, dtype=np.int64)
    enough = count >= COLUMNS_MIN
    if not enough.any():
        raise FitError(f"no profile shows a target in {COLUMNS_MIN} columns at one row")

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.add.reduceat(np.where(agree, values, 0.0), starts)
        return np.asarray(total / np.maximum(count, 1))

    centre = mean(row)
    variance = mean((row - np.repeat(centre, sizes)) ** 2)
    scatter = np.sqrt(np.maximum(variance, SIGMA_FLOOR_PX**2) / np.maximum(count, 1))
    at_mm = mean(position)[enough]
    range_mm = axis.range_at_zero_mm + axis.range_per_stage * at_mm
    if not (range_mm >= _NEAREST_MM).all():
        raise ArgumentError(
            f"range_at_zero_mm is {axis.range_at_zero_mm!r}: at a stage position of "
            f"{at_mm[np.argmin(range_mm)]:g} mm the target would be at or behind the datum"
        )
    # The blocks of a profile have this part of their errors in common.
    common_px = math.sqrt(blocks) * math.hypot(GRID_SIGMA_PX, _LATE_PX)
    targets = Targets(
        row=centre[enough],
        range_mm=range_mm,
        sigma_row_px=np.hypot(scatter, common_px)[enough],
        sigma_range_mm=_SIGMA_STAGE_MM * math.fabs(axis.range_per_stage),
        column=mean(column)[enough],
        sigma_shared_mm=axis.sigma_at_zero_mm,
        labels=[f"stage {mm:.3f} mm" for mm in at_mm.tolist()],
    )
    return targets.select(_following(targets.row, 1.0 / targets.range_mm))


def _following(row: NDArray[np.float64], inverse: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the rows near the straight line in ``1 / R`` through the median of all pairs."""
    few = np.unique(np.linspace(0, row.size - 1, min(row.size, _PAIRED_MAX)).round().astype(int))
    one, other = np.triu_indices(few.size, 1)
    run = inverse[few][other] - inverse[few][one]
    apart = run != 0.0
    if not apart.any():
        return np.ones(row.size, bool)
    slope = np.median((row[few][other] - row[few][one])[apart] / run[apart])
    away = row - slope * inverse
    return np.abs(away - np.median(away)) <= _OUTLIER_PX
