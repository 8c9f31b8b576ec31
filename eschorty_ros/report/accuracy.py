"""Range errors of a cloud against a known scene, and its completeness.

``points`` are POINT_DTYPE of shape (n,), metres in ``eschorty_base``; ``stage_direction`` is the
stage's unit vector.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction import Profiles
from eschorty_ros.core.storage import Recording
from eschorty_ros.surfaces.profiles import profile_begins, profile_index

if TYPE_CHECKING:
    from eschorty_ros.simulation.scenes import Scene

# Range per stage travel between two periods of one surface.
_SLOPE_MAX = 2.0


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sweep of the stage at constant speed under a modulated laser, or several to and fro.

    Raises ``ArgumentError`` when speed or frequency is not positive.
    """

    start_mm: float
    stop_mm: float
    speed_mm_s: float
    frequency_hz: float
    passes: int = 1

    def __post_init__(self) -> None:
        for name in ("speed_mm_s", "frequency_hz"):
            if not getattr(self, name) > 0.0:
                raise ArgumentError(f"{name} is {getattr(self, name)!r}; choose a positive value")

    @property
    def pitch_mm(self) -> float:
        """Stage travel per period, negative when the sweep runs backwards."""
        return math.copysign(self.speed_mm_s / self.frequency_hz, self.stop_mm - self.start_mm)

    @property
    def seconds(self) -> float:
        """Time from start to stop in all passes."""
        return self.passes * abs(self.stop_mm - self.start_mm) / self.speed_mm_s


@dataclass(frozen=True, slots=True)
class Accuracy:
    """A cloud against its scene."""

    periods: int
    """Modulation periods, or profiles of several, entirely within the sweep."""
    points: int
    """All points of the cloud."""
    completeness: float
    """Share of the columns lit in the middle of those periods that have a point."""
    error_median_mm: float
    error_p95_mm: float
    """Median and 95th percentile of the absolute range error."""
    bias_mm: float
    """Median of the signed range error (measured minus true)."""
    within_1_sigma: float
    within_2_sigma: float
    """Share of points whose error is within one and two of their own sigma."""
    off_target: int
    """Points where the scene has no surface; they enter no error statistic."""
    flagged: int
    """Points with a flag."""
    good_median_mm: float
    good_p95_mm: float
    good_within_1_sigma: float
    good_within_2_sigma: float
    """The same statistics of the points without a flag."""


def stage_and_range_mm(
    points: NDArray[np.void], stage_direction: tuple[float, float, float] = (0.0, 1.0, 0.0)
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return stage position and range of every point, undoing ``P = (R, 0, Z) + s t_hat``.

    Raises ``ArgumentError`` when the stage moves within the laser sheet, which leaves its position
    unknown.
    """
    along_x, along_y, _ = stage_direction
    if abs(along_y) < 1e-6:
        raise ArgumentError(
            f"stage_direction is {stage_direction!r}; it must leave the laser sheet (y not 0)"
        )
    stage_mm = points["y"].astype(np.float64) * 1e3 / along_y
    return stage_mm, points["x"].astype(np.float64) * 1e3 - stage_mm * along_x


def true_range_mm(
    scene: Scene,
    model: RangeModel,
    stage_mm: NDArray[np.float64],
    columns: NDArray[np.integer[Any]],
) -> NDArray[np.float64]:
    """Return the range of the scene at one stage position and column per point, shape (n,).

    In mm; NaN where the sheet hits nothing.
    """
    truth = np.full(len(stage_mm), np.nan)
    if truth.size == 0:
        return truth
    order = np.argsort(columns, kind="stable")
    values, starts = np.unique(columns[order], return_index=True)
    for column, members in zip(values, np.split(order, starts[1:]), strict=True):
        at = np.array([column], dtype=np.int64)
        truth[members] = scene.range_mm(stage_mm[members], at, model)[:, 0]
    return truth


def lit_columns(
    scene: Scene, model: RangeModel, positions_mm: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return a mask of the columns whose line is within the rows, shape (positions, columns)."""
    columns = np.arange(model.columns, dtype=np.int64)
    lit = np.zeros((len(positions_mm), model.columns), dtype=np.bool_)
    for index, position in enumerate(positions_mm):
        row = model.row(scene.range_mm(np.array([position]), columns, model)[0], columns)
        lit[index] = (row >= 0.0) & (row <= model.rows - 1.0)
    return lit


def range_error_mm(
    points: NDArray[np.void],
    scene: Scene,
    model: RangeModel,
    stage_direction: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> NDArray[np.float64]:
    """Return measured minus true range of every point in mm; NaN where the scene is empty."""
    stage_mm, range_mm = stage_and_range_mm(points, stage_direction)
    return np.asarray(range_mm - true_range_mm(scene, model, stage_mm, points["column"]))


def complete_periods(
    points: NDArray[np.void],
    sweep: Sweep,
    stage_direction: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the modulation periods within the sweep, from one end to the other.

    The points determine the stage position of one period; the others follow one pitch apart, with
    or without points. Without any point the first period begins with the sweep.

    Returns the stage position (mm) at the middle of the events of each period, and the index of
    each point's period, shape (n,), -1 for none.
    """
    pitch = sweep.pitch_mm
    low, high = sorted((sweep.start_mm, sweep.stop_mm))
    if len(points) == 0:
        count = int((high - low) / abs(pitch))
        positions = np.asarray(sweep.start_mm + pitch * (np.arange(count) + 0.5))
        return positions, np.zeros(0, dtype=np.int64)
    stage_mm, _ = stage_and_range_mm(points, stage_direction)
    index = profile_index(points, 1.0 / sweep.frequency_hz)
    offset = float(np.median(stage_mm - pitch * index))
    half = 0.5 * abs(pitch)
    ends = sorted(((low + half - offset) / pitch, (high - half - offset) / pitch))
    first, last = int(np.ceil(ends[0])), int(np.floor(ends[1]))
    positions = np.asarray(offset + pitch * np.arange(first, last + 1))
    return positions, np.where((index >= first) & (index <= last), index - first, -1)


def measure(
    points: NDArray[np.void],
    scene: Scene,
    model: RangeModel,
    sweep: Sweep,
    stage_direction: tuple[float, float, float] = (0.0, 1.0, 0.0),
    error_mm: NDArray[np.float64] | None = None,
) -> Accuracy:
    """Compare a cloud with its scene.

    Where several periods make a profile, profiles are counted in place of periods.

    - ``error_mm``: Result of `range_error_mm` when it is already known, shape (n,).
    """
    if error_mm is None:
        error_mm = range_error_mm(points, scene, model, stage_direction)
    lit: list[NDArray[np.bool_]] = []
    number = np.full(len(points), -1, dtype=np.int64)
    every = _periods_per_profile(points, sweep.frequency_hz)
    for mine, positions, within in _passes(points, sweep, stage_direction, every):
        before = sum(len(mask) for mask in lit)
        number[mine] = np.where(within >= 0, within + before, -1)
        lit.append(lit_columns(scene, model, positions))
    return _accuracy(points, error_mm, np.concatenate(lit), number)


def _periods_per_profile(points: NDArray[np.void], frequency_hz: float) -> int:
    """Return the number of modulation periods from most profiles to the next.

    It counts whole profiles, as a column may miss in most of them. It is 1 where the points are
    not in the order of time.
    """
    if len(points) == 0:
        return 1
    begin = profile_begins(points["column"])
    number = np.diff(begin, append=len(points))
    t_s = np.add.reduceat(points["t"], begin) / number
    apart = np.rint(np.diff(t_s) * frequency_hz).astype(np.int64)
    return int(np.bincount(apart).argmax()) if apart.size and apart.min() > 0 else 1


def _passes(
    points: NDArray[np.void],
    sweep: Sweep,
    stage_direction: tuple[float, float, float],
    every: int = 1,
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.int64]]]:
    """Yield which points are of each pass, and its periods as `complete_periods`.

    ``every`` is the number of modulation periods that count as one.
    """
    of_pass = pass_index(points, sweep, stage_direction)
    sweep = replace(sweep, frequency_hz=sweep.frequency_hz / every)
    turned = replace(sweep, start_mm=sweep.stop_mm, stop_mm=sweep.start_mm)
    for index in range(sweep.passes):
        mine = of_pass == index
        one = turned if index % 2 else sweep
        yield mine, *complete_periods(points[mine], one, stage_direction)


def recorded_truth(
    points: NDArray[np.void], scene: Scene, recording: Recording, sweep: Sweep
) -> NDArray[np.void]:
    """Return the scene's ranges at the periods of a recorded scan, by its stage's log.

    Returns TRUTH_DTYPE, one row per whole period and column whose line is on the sensor.

    - ``points``: The scan's cloud: it shows where the periods are.
    - ``recording``: Of the scan, as the nodes recorded it.
    """
    from eschorty_ros.simulation.world.truth_log import TruthLog

    samples, calibration = recording.stage_samples, recording.calibration
    at_mm, t_us = samples["position_mm"], samples["t_us"]
    log = TruthLog(scene, calibration.model())
    passes = _passes(points, sweep, calibration.stage_direction)
    for number, (_, positions, _) in enumerate(passes):
        for position in positions:
            below = at_mm < position
            # Those of the sweep are the last: the stage may cross it on the way to the start.
            crossed = np.flatnonzero(below[1:] != below[:-1])[-sweep.passes :]
            crossed = crossed[number : number + 1]
            if not crossed.size:
                continue
            ends = slice(crossed[0], crossed[0] + 2)
            share = (position - at_mm[ends][0]) / np.diff(at_mm[ends])[0]
            log.add(t_us[ends][0] + round(share * np.diff(t_us[ends])[0]), position)
    return log.table()


def pass_index(
    points: NDArray[np.void],
    sweep: Sweep,
    stage_direction: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> NDArray[np.int64]:
    """Return the number of each point's pass, from the stage's direction in each period."""
    if sweep.passes == 1 or len(points) == 0:
        return np.zeros(len(points), dtype=np.int64)
    stage_mm, _ = stage_and_range_mm(points, stage_direction)
    period = profile_index(points, 1.0 / sweep.frequency_hz)
    count = np.maximum(np.bincount(period), 1)
    t_s = points["t"] - (np.bincount(period, points["t"]) / count)[period]
    forth = np.sign(np.bincount(period, t_s * stage_mm)) * np.sign(sweep.pitch_mm)
    of_period = np.zeros(len(forth), dtype=np.int64)
    begin = 0
    for number in range(1, sweep.passes):
        # The turn is where most periods before and after it have their direction.
        two = 2 * (len(forth) - begin) // (sweep.passes - number + 1)
        balance = np.cumsum(forth[begin : begin + two]) * (1 if number % 2 else -1)
        begin += int(np.argmax(balance)) + 1 if two else 0
        of_period[begin:] = number
    return of_period[period]


def measure_recorded(
    points: NDArray[np.void], profiles: Profiles, recording: Recording
) -> Accuracy | None:
    """Compare a cloud with the truth of its recording; ``None`` without ``truth.csv``.

    Where several periods make a profile, profiles are counted in place of periods.

    - ``profiles``: The same points with their sensor times.
    """
    truth = recording.truth
    if truth is None or len(truth) == 0:
        return None
    model = recording.calibration.model()
    times, period = np.unique(truth["t_us"], return_inverse=True)
    true_mm = np.full((len(times), model.columns), np.nan)
    true_mm[period, np.minimum(truth["column"], model.columns - 1)] = truth["range_mm"]
    after = np.minimum(np.searchsorted(times, profiles.t_us), len(times) - 1)
    before = np.maximum(after - 1, 0)
    share = (profiles.t_us - times[before]) / np.maximum(times[after] - times[before], 1)
    number = np.where(share < 0.5, before, after)
    apart_us = np.abs(profiles.t_us - times[number])
    number[apart_us > 0.5 * recording.modulation.period_us] = -1
    first, last = true_mm[before, profiles.column], true_mm[after, profiles.column]
    # Steeper than that is a step: the point is on one of its sides.
    stage_mm = recording.stage.position_mm(times)
    flat = np.abs(last - first) <= _SLOPE_MAX * np.abs(stage_mm[after] - stage_mm[before])
    nearest = np.where(share < 0.5, first, last)
    expected_mm = np.where(flat, first + np.clip(share, 0.0, 1.0) * (last - first), nearest)
    error_mm = np.where(number >= 0, profiles.range_mm - expected_mm, np.nan)
    lit = np.isfinite(true_mm)
    apart = np.diff(np.unique(profiles.edge_us))
    every = round(float(np.median(apart)) / recording.modulation.period_us) if apart.size else 1
    if every > 1 and (number >= 0).any():
        # A profile stands for the period in its middle.
        phase = int(number[number >= 0].min()) % every
        lit = lit[phase::every]
        profile = np.rint((number - phase) / every).astype(np.int64)
        number = np.where(number >= 0, np.clip(profile, 0, len(lit) - 1), -1)
    # Before the first period with a truth and after the last one nothing is known.
    off_target = int(np.count_nonzero(np.isnan(error_mm) & (number >= 0)))
    return replace(_accuracy(points, error_mm, lit, number), off_target=off_target)


def _accuracy(
    points: NDArray[np.void],
    error_mm: NDArray[np.float64],
    lit: NDArray[np.bool_],
    number: NDArray[np.integer[Any]],
) -> Accuracy:
    """Return the statistics of points whose periods, lines of ``lit``, are ``number``."""
    with_point = np.zeros_like(lit)
    with_point[number[number >= 0], points["column"][number >= 0]] = True
    expected, found = int(lit.sum()), int(np.count_nonzero(lit & with_point))
    known = np.isfinite(error_mm)
    error = error_mm[known]
    size = np.abs(error)
    ratio = size / (points["sigma"][known].astype(np.float64) * 1e3)
    good = points["flags"][known] == 0
    return Accuracy(
        periods=len(lit),
        points=len(points),
        completeness=found / expected if expected else math.nan,
        error_median_mm=_or_nan(np.median, size),
        error_p95_mm=_or_nan(_p95, size),
        bias_mm=_or_nan(np.median, error),
        within_1_sigma=_or_nan(np.mean, ratio <= 1.0),
        within_2_sigma=_or_nan(np.mean, ratio <= 2.0),
        off_target=int(np.count_nonzero(~known)),
        flagged=int(np.count_nonzero(points["flags"])),
        good_median_mm=_or_nan(np.median, size[good]),
        good_p95_mm=_or_nan(_p95, size[good]),
        good_within_1_sigma=_or_nan(np.mean, ratio[good] <= 1.0),
        good_within_2_sigma=_or_nan(np.mean, ratio[good] <= 2.0),
    )


def _p95(size: NDArray[np.float64]) -> Any:
    return np.percentile(size, 95.0)


def _or_nan(statistic: Callable[[Any], Any], values: NDArray[Any]) -> float:
    """Return a statistic of ``values``, NaN without any."""
    return float(statistic(values)) if values.size else math.nan
