"""How late the points of a scan back and forth are, from the two passes.

Pixels respond late to a line that moves, so that a row shows an earlier surface. A pass forth and
one back are late in opposite directions along the stage: where they overlap, ranges differ by the
slope of the surface times the travel in the lag, twice. An offset between the clocks of camera and
stage does the same. In a single pass a lag moves the cloud as a whole, which nothing shows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.numbers import SIGMA_PER_MAD
from eschorty_ros.core.clocks import StageTrack
from eschorty_ros.core.reconstruction.profiles import add_stage, stage_offset_m

# Columns of a cell; bands of columns, the scatter of whose lags gives the deviation of their mean.
_COLUMNS = 8
_BANDS = 16
# Steeper cells are on a step, and those whose slope does not go on for this distance to either
# side: the thickness of the line makes a slope of a step.
_SLOPE_MAX = 1.0
_SMOOTH_MM = 8.0
# Least cells of a band, and least bands that have them.
_CELLS_MIN = 16
_BANDS_MIN = 4
# Cells further off than this many deviations show something that moved between the passes.
_DEVIATIONS_MAX = 4.0
_ROUNDS = 3
# A lag of less than this many standard deviations is none.
_SURE = 3.0
# Half the time over which the stage's speed is measured.
_SPEED_US = 20_000
# More points do not make the lag better.
_POINTS_MAX = 1 << 22
# Points that show whether there are passes in both directions.
_POINTS_SEEN = 4096
_CHUNK = 1 << 20


class PassLag(NamedTuple):
    """Lag of points behind the stage, us, and its standard deviation."""

    lag_us: float
    sigma_us: float

    def __str__(self) -> str:
        return f"{1e-3 * self.lag_us:.2f} ± {1e-3 * self.sigma_us:.2f} ms"


class _Samples(NamedTuple):
    """Points that a lag is estimated from: position and speed of the stage, block of columns."""

    stage_mm: NDArray[np.float64]
    speed_mm_us: NDArray[np.float64]
    block: NDArray[np.int64]
    range_mm: NDArray[np.float64]


def pass_lag(
    points: NDArray[np.void], origin_us: int, track: StageTrack, stage_direction: ArrayLike
) -> PassLag | None:
    """Return how late the points of passes in both directions are.

    ``None`` where passes do not overlap on slopes, or the lag is not above its error.

    - ``points``: POINT_DTYPE, shape (n,): placed, in any order.
    - ``origin_us``: Time of the track at which their ``t`` is 0.
    - ``stage_direction``: Unit vector, shape (3,).
    """
    some = _speed_mm_us(points[:: 1 + len(points) // _POINTS_SEEN], origin_us, track)
    if np.unique(np.sign(some[_cruises(some)])).size < 2:
        return None
    samples = _samples(points, origin_us, track, stage_direction)
    lag = PassLag(0.0, np.inf)
    for _ in range(_ROUNDS):
        left = _lag_left(samples, lag.lag_us)
        if left is None:
            return None
        lag = PassLag(lag.lag_us + left.lag_us, left.sigma_us)
    return lag if abs(lag.lag_us) > _SURE * lag.sigma_us else None


def take_off_lag(
    points: NDArray[np.void],
    origin_us: int,
    track: StageTrack,
    stage_direction: ArrayLike,
    lag_us: float,
) -> None:
    """Move points in place to where the stage was ``lag_us`` before, and their ``t`` as well."""
    for begin in range(0, len(points), _CHUNK):
        part = points[begin : begin + _CHUNK]
        t_us = _times_us(part, origin_us)
        moved_mm = track.position_mm(t_us - round(lag_us)) - track.position_mm(t_us)
        add_stage(part, np.nan_to_num(moved_mm), stage_direction)
        part["t"] -= round(lag_us) * 1e-6


def _times_us(points: NDArray[np.void], origin_us: int) -> NDArray[np.int64]:
    return np.rint(np.nan_to_num(points["t"]) * 1e6).astype(np.int64) + origin_us


def _speed_mm_us(
    points: NDArray[np.void], origin_us: int, track: StageTrack
) -> NDArray[np.float64]:
    """Return the stage's speed at each point; 0 where the track does not cover it."""
    t_us = _times_us(points, origin_us)
    moved_mm = track.position_mm(t_us + _SPEED_US) - track.position_mm(t_us - _SPEED_US)
    return np.nan_to_num(moved_mm) / (2 * _SPEED_US)


def _cruises(speed_mm_us: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return where the stage is faster than half of its highest speed."""
    return np.abs(speed_mm_us) > 0.5 * np.abs(speed_mm_us).max(initial=0.0)


def _samples(
    points: NDArray[np.void], origin_us: int, track: StageTrack, stage_direction: ArrayLike
) -> _Samples:
    """Return the good points of a cruising stage, of many points those of some blocks."""
    every = 1 + len(points) // _POINTS_MAX
    used = points[(points["flags"] == 0) & (points["column"] // _COLUMNS % every == 0)]
    speed = _speed_mm_us(used, origin_us, track)
    cruising = _cruises(speed)
    used = used[cruising]
    stage_mm = track.position_mm(_times_us(used, origin_us))
    return _Samples(
        stage_mm,
        speed[cruising],
        used["column"].astype(np.int64) // _COLUMNS,
        (used["x"] - stage_offset_m(stage_mm, stage_direction)[0]) * 1e3,
    )


def _lag_left(samples: _Samples, lag_us: float) -> PassLag | None:
    """Return what is left of the lag when ``lag_us`` is taken off.

    The slopes of the two passes have errors of their own, so that the mean of their product is the
    square of the slope.
    """
    if samples.block.size == 0:
        return None
    at_mm = samples.stage_mm - lag_us * samples.speed_mm_us
    block = samples.block - samples.block.min()
    # A cell has a profile of either pass, in some two.
    pitch_mm = 2.5 * np.ptp(at_mm) * np.unique(block).size * _COLUMNS / at_mm.size
    if pitch_mm == 0.0:
        return None
    place = ((at_mm - at_mm.min()) / pitch_mm).astype(np.int64)
    shape = int(place.max()) + 1, int(block.max()) + 1
    stage_mm, speed, range_mm = np.empty((3, 2, *shape))
    for back, mine in enumerate((samples.speed_mm_us > 0.0, samples.speed_mm_us < 0.0)):
        cell = place[mine] * shape[1] + block[mine]
        number = np.bincount(cell, minlength=shape[0] * shape[1]).astype(float)
        number[number < _COLUMNS // 2] = np.nan
        for means, values in (
            (stage_mm, at_mm), (speed, samples.speed_mm_us), (range_mm, samples.range_mm)
        ):  # fmt: skip
            means[back] = (np.bincount(cell, values[mine], number.size) / number).reshape(shape)
    slopes = _slopes(range_mm, stage_mm, 1)[:, 1:-1]
    slope, square = slopes.mean(axis=0), slopes.prod(axis=0)
    half = max(round(0.5 * _SMOOTH_MM / pitch_mm), 1)
    beside = _slopes(range_mm, stage_mm, half).mean(axis=0)
    (forth_mm, back_mm), faster = stage_mm[:, 1:-1], np.diff(speed[:, 1:-1], axis=0)[0]
    apart_mm = range_mm[0, 1:-1] - range_mm[1, 1:-1] - slope * (forth_mm - back_mm)
    known = np.isfinite(apart_mm) & (np.abs(slopes) < _SLOPE_MAX).all(axis=0)
    for shift in (-half, half):
        known &= np.abs(slope - np.roll(beside, shift, axis=0)[1:-1]) < 0.5 * np.abs(slope)
    left_us = 0.0
    for _ in range(_ROUNDS):
        if not known.any():
            return None
        products = np.where(known, slope * faster * apart_mm, 0.0).sum(axis=0)
        squares = np.where(known, square * faster * faster, 0.0).sum(axis=0)
        left_us = products.sum() / squares.sum()
        error_mm = np.abs(apart_mm - left_us * slope * faster)
        deviation_mm = SIGMA_PER_MAD * np.median(error_mm[known])
        known &= error_mm <= _DEVIATIONS_MAX * deviation_mm
    bands = np.array_split(np.arange(shape[1]), _BANDS)
    enough = [band for band in bands if known[:, band].sum() >= _CELLS_MIN]
    if len(enough) < _BANDS_MIN:
        return None
    errors = [products[band].sum() - left_us * squares[band].sum() for band in enough]
    return PassLag(float(left_us), float(np.linalg.norm(errors) / abs(squares.sum())))


def _slopes(
    range_mm: NDArray[np.float64], stage_mm: NDArray[np.float64], reach: int
) -> NDArray[np.float64]:
    """Return the slopes between the cells ``reach`` before and after each; NaN without these."""
    slopes = np.full(range_mm.shape, np.nan)
    two = 2 * reach
    if range_mm.shape[1] > two:
        rise_mm = range_mm[:, two:] - range_mm[:, :-two]
        slopes[:, reach:-reach] = rise_mm / (stage_mm[:, two:] - stage_mm[:, :-two])
    return slopes
