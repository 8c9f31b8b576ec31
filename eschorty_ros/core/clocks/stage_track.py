"""The stage's position as a function of time, us of one clock."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.array_queue import ArrayQueue
from eschorty_ros.core.base.arrays import reals, times
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer

NM_PER_MM = 1_000_000
POSITION_LIMIT_MM = 1e9
SPEED_LIMIT_MM_S = 1e4


def quantise_nm(position_mm: ArrayLike, name: str = "position_mm") -> NDArray[np.int64]:
    """Return positions rounded to the nanometre, int64.

    Positions read from text with six decimals and from ROS metres give the same integers, so a
    recording and the live nodes place points identically. ``name`` is used in errors.

    Raises ``ArgumentError`` when a position is not finite or farther than 1e9 mm.
    """
    position = reals(name, position_mm)
    wrong = ~(np.abs(position) <= POSITION_LIMIT_MM)
    if wrong.any():
        raise ArgumentError(
            f"{name} is {float(position[wrong][0])!r}; give finite positions within "
            f"{POSITION_LIMIT_MM:g} mm"
        )
    return np.rint(position * NM_PER_MM).astype(np.int64)


class StageTrack:
    """Stage positions over time, linear between samples, never extrapolated.

    Parameters
    ----------
    max_gap_us : int, optional
        Longest gap between two samples that is interpolated, us; ``None`` for any.

    Attributes
    ----------
    dropped : int
        Samples refused because they were not later than the one before.
    """

    def __init__(self, max_gap_us: int | None = None) -> None:
        if max_gap_us is not None:
            integer("max_gap_us", max_gap_us, 1, TIME_LIMIT)
        self.max_gap_us = max_gap_us
        self.dropped = 0
        # Times in us and positions in nm.
        self._samples = ArrayQueue((np.int64, np.int64), 256)

    def __len__(self) -> int:
        """Return the count of samples kept."""
        return len(self._samples)

    @property
    def first_us(self) -> int | None:
        """Time of the oldest sample kept, ``None`` when there is none."""
        return int(self._samples.arrays[0][0]) if len(self) else None

    @property
    def last_us(self) -> int | None:
        """Time of the newest sample, ``None`` when there is none."""
        return int(self._samples.arrays[0][-1]) if len(self) else None

    def append(self, t_us: ArrayLike, position_mm: ArrayLike) -> None:
        """Add samples; those not later than all before them are dropped and counted.

        Parameters
        ----------
        t_us : int or array_like of int, shape (n,)
            Sensor time, us.
        position_mm : float or array_like, shape (n,)
            Position, quantised to 1 nm.

        Raises
        ------
        ArgumentError
            For fractional times, unequal lengths or positions that are not finite.
        """
        at_us = np.atleast_1d(times("t_us", t_us))
        positions = np.atleast_1d(quantise_nm(position_mm))
        if at_us.ndim != 1 or at_us.shape != positions.shape:
            raise ArgumentError(
                f"t_us has shape {at_us.shape} and position_mm {positions.shape}; "
                "give one position for each time"
            )
        floor = np.iinfo(np.int64).min if self.last_us is None else self.last_us
        newest_before = np.maximum.accumulate(np.concatenate(([floor], at_us)))[:-1]
        later = at_us > newest_before
        self.dropped += int(later.size - np.count_nonzero(later))
        self._samples.append((at_us[later], positions[later]))

    def position_mm(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the stage position at times of the samples' clock.

        Parameters
        ----------
        t_us : array_like of int, any shape
            Sensor time, us.

        Returns
        -------
        ndarray of float64, shape of ``t_us``
            mm; NaN outside the samples and inside a gap longer than ``max_gap_us``.
        """
        query = times("t_us", t_us)
        held, nm = self._samples.arrays
        if held.size == 0 or query.size == 0:
            return np.full(query.shape, np.nan)
        low, high = query.min(), query.max()
        outside = low < held[0] or high > held[-1]
        # The times of a few profiles are between two samples or three.
        first, last = np.searchsorted(held, [low, high], side="right") - 1
        held, nm = (kept[max(first, 0) : last + 2] for kept in (held, nm))
        right = np.minimum(np.arange(1, held.size + 1), held.size - 1)
        gap, step_nm = held[right] - held, (nm[right] - nm).astype(np.float64)
        left = 0 if first == last else np.searchsorted(held[1:], query, side="right")
        since = query - held[left]
        part = since / np.maximum(gap, 1)[left]
        position = np.asarray((nm[left] + step_nm[left] * part) / NM_PER_MM)
        if outside:
            position[(query < held[0]) | (query > held[-1])] = np.nan
        if self.max_gap_us is not None and (gap > self.max_gap_us).any():
            position[(gap > self.max_gap_us)[left] & (since > 0)] = np.nan
        return position

    def samples_from(self, t_us: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return times and positions (mm) of the samples kept, those before ``t_us`` left out."""
        at_us, nm = self._samples.arrays
        kept = at_us >= t_us
        return at_us[kept], nm[kept] / NM_PER_MM

    def drop_before(self, t_us: int) -> None:
        """Drop samples that no query at ``t_us`` or later needs."""
        integer("t_us", t_us, -TIME_LIMIT, TIME_LIMIT)
        at_us, _ = self._samples.arrays
        self._samples.drop(max(int(np.searchsorted(at_us, t_us, side="right")) - 1, 0))
