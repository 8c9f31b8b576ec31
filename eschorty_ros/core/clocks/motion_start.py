"""Start and shape of a motion, from bounds on the times at which it passes positions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.clocks.motion import MotionPlan, plan_move

# Readings at less than this share of the fastest one's speed do not determine the start.
_FAST_SHARE = 0.5
_SHAPE_READINGS_MIN = 8
_SPEED_SIGMA = 0.02
_ACCELERATION_SIGMA = 0.3


@dataclass(frozen=True, slots=True)
class Delays:
    """Mean time (s) from request to sample and from sample to receipt, without the transfer.

    A request is written to an idle line; an answer is delayed by adapter, kernel and scheduler.
    """

    before_s: float = 1e-4
    after_s: float = 1e-3


@dataclass(frozen=True, slots=True)
class Timing:
    """Start of a motion (s), its standard deviation (s), and which readings agree with it.

    It is between ``begin_s`` and ``end_s``; ``begin_s`` is -inf where no request is known.
    """

    start_s: float
    sigma_s: float
    begin_s: float
    end_s: float
    agreeing: NDArray[np.bool_]
    delays: Delays
    bounded_below: bool = False


def start_of(
    earliest_s: Array, latest_s: Array, slack_s: Array, speed: Array, usual: Delays
) -> Timing:
    """Return the start, estimated from the bounds of each reading.

    Delays are positive: the true start is after all ``earliest`` and before all ``latest``. The
    extremes are off by the mean delay over the number of readings, as for exponential delays; the
    two are averaged with the inverse squares of that as weights. The usual delay counts as one
    more reading.

    - ``earliest_s``, ``latest_s``: Shape (n,). ``-inf`` for an unknown earliest.
    - ``slack_s``: Shape (n,). Uncertainty of time due to that of the position.
    - ``speed``: Shape (n,).
    - ``usual``: Of earlier motions.
    """
    begin, end = _widest_agreement(earliest_s - slack_s, latest_s + slack_s)
    middle = 0.5 * (begin + end) if np.isfinite(begin) else end
    agreeing = (earliest_s - slack_s <= middle) & (latest_s + slack_s >= middle)
    use = agreeing & (speed >= _FAST_SHARE * speed[agreeing].max(initial=0.0))
    if not use.any():
        return Timing(middle, float(end - begin), begin, end, agreeing, usual)
    floor_s = float(slack_s[use].min()) + 1e-9
    after = _lower_end(latest_s[use], usual.after_s, floor_s)
    known = use & np.isfinite(earliest_s)
    if not known.any():
        delays = Delays(usual.before_s, after.delay_s)
        return Timing(after.end_s, after.error_s, begin, end, agreeing, delays)
    before = _lower_end(-earliest_s[known], usual.before_s, floor_s)
    weights = np.array([after.error_s**-2, before.error_s**-2])
    joined = float(weights @ np.array([after.end_s, -before.end_s]) / weights.sum())
    low, high = sorted((float(latest_s[use].min()), float(earliest_s[known].max())))
    sigma_s = float(weights.sum() ** -0.5)
    start_s = min(max(joined, low), high)
    delays = Delays(before.delay_s, after.delay_s)
    return Timing(start_s, sigma_s, begin, end, agreeing, delays, bounded_below=True)


def _widest_agreement(low: Array, high: Array) -> tuple[float, float]:
    """Return the interval that most of the intervals share (Marzullo 1984)."""
    ends = np.concatenate((low, high))
    steps = np.concatenate((np.ones(low.size), -np.ones(high.size)))
    order = np.lexsort((-steps, ends))
    depth = np.cumsum(steps[order])
    best = int(np.argmax(depth))
    return float(ends[order][best]), float(ends[order][min(best + 1, ends.size - 1)])


class _LowerEnd(NamedTuple):
    """Lower end of positive delays, its error, and the mean delay."""

    end_s: float
    error_s: float
    delay_s: float


def _lower_end(values: Array, usual_s: float, floor_s: float) -> _LowerEnd:
    """Return the lower end of times with positive delays."""
    least, count = float(values.min()), values.size
    mean_s = float(values.mean()) - least + usual_s / count
    correction = mean_s / count
    return _LowerEnd(least - correction, max(correction, floor_s), mean_s)


def fitted_shape(
    plan: MotionPlan, positions: Array, earliest_s: Array, latest_s: Array
) -> MotionPlan | None:
    """Return trapezoid ``plan`` with the speed and acceleration that fit the readings' times best.

    Least squares on the middle of each reading's interval, with the plan's own values as a prior
    of 2 % in speed and 30 % in acceleration. ``None`` where the readings are too few.
    """
    # A reading beyond the target, such as one of an overshoot, is passed at no time.
    passing_s = plan.passing_s(positions)
    reached = np.isfinite(passing_s)
    positions, earliest_s, latest_s = positions[reached], earliest_s[reached], latest_s[reached]
    if positions.size < _SHAPE_READINGS_MIN or len(plan.durations_s) != 3:
        return None
    acceleration = abs(plan.accelerations_mm_s2[0])
    speed = acceleration * plan.durations_s[0]
    known = np.isfinite(earliest_s)
    middle = np.where(known, 0.5 * (np.where(known, earliest_s, 0.0) + latest_s), latest_s)
    spread = np.where(known, latest_s - np.where(known, earliest_s, 0.0), 0.0)
    weight = 1.0 / (np.where(known, spread, np.max(spread, initial=1e-3)) + 1e-4)

    def shaped(log_speed: float, log_acceleration: float) -> MotionPlan:
        return plan_move(
            plan.start_ns,
            plan.position_mm,
            plan.end_mm,
            speed * math.exp(log_speed),
            acceleration * math.exp(log_acceleration),
        )

    # The import takes longer than a reading of the stage.
    from scipy.optimize import least_squares

    def residuals(parameters: Array) -> Array:
        start_s, log_speed, log_acceleration = parameters
        passing_s = shaped(log_speed, log_acceleration).passing_s(positions)
        late = np.nan_to_num(middle - start_s - passing_s) * weight
        prior = (log_speed / _SPEED_SIGMA, log_acceleration / _ACCELERATION_SIGMA)
        return np.concatenate((late, prior))

    start_s = float(np.median(middle - passing_s[reached]))
    fit = least_squares(residuals, (start_s, 0.0, 0.0), diff_step=1e-5, x_scale="jac")
    return shaped(fit.x[1], fit.x[2])
