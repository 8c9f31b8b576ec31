"""When a known motion began, from samples whose times are known to within intervals only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.motion import MotionPlan, plan_move

Array = NDArray[np.float64]

# A share of the fastest samples' speed below which a sample says little about time.
_FAST = 0.5
_LEAST_SAMPLES = 8
_ITERATIONS = 12
_SPEED_PRIOR = 0.02
_ACCELERATION_PRIOR = 0.3


@dataclass(frozen=True, slots=True)
class Delays:
    """Mean time (s) from request to sample and from sample to receipt, the line's own left out.

    A request is written to an idle line; an answer waits for adapter, kernel and scheduler.
    """

    before_s: float = 1e-4
    after_s: float = 1e-3


@dataclass(frozen=True, slots=True)
class Timing:
    """Start of a motion (s), its standard deviation (s), and which samples agree with it."""

    start_s: float
    sigma_s: float
    agreeing: NDArray[np.bool_]
    delays: Delays
    bounded_below: bool = False


def widest_agreement(low: Array, high: Array) -> tuple[float, float]:
    """Times that most of the intervals share (Marzullo 1984): a few wrong ones do no harm."""
    ends = np.concatenate((low, high))
    steps = np.concatenate((np.ones(low.size), -np.ones(high.size)))
    order = np.lexsort((-steps, ends))
    depth = np.cumsum(steps[order])
    best = int(np.argmax(depth))
    return float(ends[order][best]), float(ends[order][min(best + 1, ends.size - 1)])


def start_of(
    earliest_s: Array, latest_s: Array, slack_s: Array, speed: Array, usual: Delays
) -> Timing:
    """Start from each sample's earliest and latest, as the sample alone would have it.

    Delays are positive: the true start is after all ``earliest`` and before all ``latest``. The
    extremes miss it by the mean delay over the number of samples, as for exponential delays; both
    sides are joined by the inverse squares of that. The usual delay counts as one sample more.

    Parameters
    ----------
    earliest_s, latest_s : float64, shape (n,)
        ``-inf`` for an unknown earliest.
    slack_s : float64, shape (n,)
        Uncertainty of time that the position's own brings.
    speed : float64, shape (n,)
    usual : Delays
        Of earlier motions.
    """
    begin, end = widest_agreement(earliest_s - slack_s, latest_s + slack_s)
    middle = 0.5 * (begin + end) if np.isfinite(begin) else end
    agreeing = (earliest_s - slack_s <= middle) & (latest_s + slack_s >= middle)
    use = agreeing & (speed >= _FAST * speed[agreeing].max(initial=0.0))
    if not use.any():
        return Timing(middle, float(end - begin), agreeing, usual)
    floor_s = float(slack_s[use].min()) + 1e-9
    after, late_s, after_s = _extreme(latest_s[use], usual.after_s, floor_s)
    known = use & np.isfinite(earliest_s)
    if not known.any():
        return Timing(after, late_s, agreeing, Delays(usual.before_s, after_s))
    before, early_s, before_s = _extreme(-earliest_s[known], usual.before_s, floor_s)
    weights = np.array([late_s**-2, early_s**-2])
    joined = float(weights @ np.array([after, -before]) / weights.sum())
    low, high = sorted((float(latest_s[use].min()), float(earliest_s[known].max())))
    sigma_s = float(weights.sum() ** -0.5)
    start_s = min(max(joined, low), high)
    return Timing(start_s, sigma_s, agreeing, Delays(before_s, after_s), bounded_below=True)


def _extreme(values: Array, usual_s: float, floor_s: float) -> tuple[float, float, float]:
    """Lower end of positive delays, the error of it, and the mean delay."""
    least, count = float(values.min()), values.size
    mean_s = float(values.mean()) - least + usual_s / count
    correction = mean_s / count
    return least - correction, max(correction, floor_s), mean_s


def refined_shape(
    plan: MotionPlan, positions: Array, earliest_s: Array, latest_s: Array
) -> MotionPlan | None:
    """Trapezoid ``plan`` with the speed and acceleration that suit the readings' times best.

    Least squares on the middle of each reading's interval, with the plan's own values as a prior
    of 2 % in speed and 30 % in acceleration. ``None`` where the readings do not tell.
    """
    if positions.size < _LEAST_SAMPLES or len(plan.durations_s) != 3:
        return None
    acceleration = abs(plan.accelerations_mm_s2[0])
    speed = acceleration * plan.durations_s[0]
    known = np.isfinite(earliest_s)
    middle = np.where(known, 0.5 * (np.where(known, earliest_s, 0.0) + latest_s), latest_s)
    spread = np.where(known, latest_s - np.where(known, earliest_s, 0.0), 0.0)
    weight = 1.0 / (np.where(known, spread, np.max(spread, initial=1e-3)) + 1e-4)

    def shaped(parameters: Array) -> MotionPlan:
        return plan_move(
            plan.start_ns,
            plan.position_mm,
            plan.end_mm,
            speed * float(np.exp(parameters[1])),
            acceleration * float(np.exp(parameters[2])),
        )

    def residual(parameters: Array) -> Array:
        passing_s = shaped(parameters).passing_s(positions)
        own = np.nan_to_num(middle - parameters[0] - passing_s) * weight
        prior = parameters[1:] / np.array([_SPEED_PRIOR, _ACCELERATION_PRIOR])
        return np.concatenate((own, prior))

    # Least squares with the start free; logarithms keep speed and acceleration positive.
    parameters = np.array([float(np.median(middle - plan.passing_s(positions))), 0.0, 0.0])
    if not np.isfinite(parameters[0]):
        return None
    for _ in range(_ITERATIONS):
        now = residual(parameters)
        step = 1e-5
        jacobian = np.stack(
            [(residual(parameters + step * unit) - now) / step for unit in np.eye(3)], axis=1
        )
        change, *_ = np.linalg.lstsq(jacobian, -now, rcond=None)
        parameters = parameters + np.clip(change, -0.2, 0.2)
        if np.abs(change).max() < 1e-9:
            break
    return shaped(parameters)
