"""Pulses of a stage at equal distances, and their edges at a trigger input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import integer_vector, reals
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer, number, positive


@dataclass(frozen=True, slots=True)
class PulseTrain:
    """Pulses of a stage: number n, below ``count``, begins at ``first_mm + n interval_mm``.

    Raises ``ArgumentError`` when a number is not finite, the interval not positive or the count
    negative.
    """

    first_mm: float
    interval_mm: float
    count: int

    def __post_init__(self) -> None:
        number("first_mm", self.first_mm, -1e6, 1e6)
        positive("interval_mm", self.interval_mm)
        integer("count", self.count, 0, 1 << 31)

    def nearest(self, position_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the number of the pulse nearest to each position; NaN stays."""
        n = np.rint((reals("position_mm", position_mm) - self.first_mm) / self.interval_mm)
        return np.clip(n, 0, max(self.count - 1, 0))

    def offset_mm(self, position_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signed distance of each position from its nearest pulse; NaN stays."""
        pulse_mm = self.first_mm + self.nearest(position_mm) * self.interval_mm
        return reals("position_mm", position_mm) - pulse_mm


def checked_edges(
    t_us: NDArray[np.int64], polarity: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return times and polarities of edges; raise ``ArgumentError`` where they are none."""
    t_us = integer_vector("t_us", t_us, np.int64, -TIME_LIMIT, TIME_LIMIT)
    polarity = integer_vector("polarity", polarity, np.uint8, 0, 1)
    if t_us.shape != polarity.shape:
        raise ArgumentError(
            f"t_us has {t_us.size} edges and polarity {polarity.size}; give one for each"
        )
    return t_us, polarity


def leading_edges(t_us: NDArray[np.int64], polarity: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the edges with which the pulses begin, out of rising and falling ones.

    All pulses have one width and the gaps between them vary with the speed: pulses begin with the
    rising edge when the time from rising to falling edges varies less than that from falling to
    rising ones, or is the shorter one if both vary alike. Edges of one kind only are returned
    unchanged.

    - ``t_us``: Shape (n,). In time order.
    - ``polarity``: Shape (n,). 1 for rising.
    """
    t_us, polarity = checked_edges(t_us, polarity)
    rising = polarity == 1
    if rising.all() or not rising.any():
        return t_us
    gap = np.diff(t_us)
    high, low = gap[rising[:-1] & ~rising[1:]], gap[~rising[:-1] & rising[1:]]
    begins_rising = not (high.size and low.size) or np.median(high) <= np.median(low)
    if min(high.size, low.size) >= 3:
        spread = [float(np.subtract(*np.quantile(gaps, (0.8, 0.2)))) + 1.0 for gaps in (high, low)]
        if max(spread) >= 1.5 * min(spread):
            begins_rising = spread[0] < spread[1]
    return t_us[rising] if begins_rising else t_us[~rising]
