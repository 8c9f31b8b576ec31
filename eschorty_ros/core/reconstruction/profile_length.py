"""How many periods make a profile: as many as give a column enough events for a point."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.line import TIME_LIMIT_US
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.held_events import HeldEvents
from eschorty_ros.core.modulation.phase_estimate import estimate_phase, estimation_window
from eschorty_ros.core.modulation.phase_lock import BLOCK_US

PERIODS_MAX = 1000
EVENTS_WANTED = 16
"""Events per column and profile that a point should have."""
_BLOCK_PERIODS = 2
_BLOCK_EVENTS = 1 << 16
_HELD_EVENTS_MAX = 1 << 22
# Events of a window that are looked at, evenly spread.
_SAMPLE = 4096
# Cells of 16 x 16 pixels: a line is in one to four of a column's 45, background in all.
_CELL_BITS = 4
_LINE_CELLS_MAX = 8.0


def periods_max(modulation: Modulation) -> int:
    """Return the most periods of a profile: the time within it is limited."""
    return min(PERIODS_MAX, math.ceil(TIME_LIMIT_US / modulation.period_us) - 2)


class ProfileLength:
    """Chooses the periods of a profile from the first events that follow the laser.

    They are a block behind the first estimation window that is modulated, or has a line where
    pixels are too slow to follow: the choice does not depend on how the stream is split, nor on the
    background before the laser is on. Of their columns, weighted by events, one has ``sum n^2 / sum
    n - 1`` events, with ``n`` the events of each column. One period is a profile where it has half
    of `EVENTS_WANTED`: of Poisson counts with a mean of 8, one in 24 is less than 4, the default of
    ``events_min``. Else a profile gets as many periods as give `EVENTS_WANTED`. Where the first
    block gives less than that in a period the next one counts, since pixels give more when the
    laser is switched on. Blocks without light do not count. A block has `BLOCK_US`, or whole
    periods with enough events, but two periods at least.

    Parameters
    ----------
    modulation : Modulation
    """

    def __init__(self, modulation: Modulation) -> None:
        self._modulation = modulation
        self._span_us = max(BLOCK_US, round(_BLOCK_PERIODS * modulation.period_us))
        self._seen = 0
        self._window: tuple[int, int] | None = None

    def choose(self, held: HeldEvents, watermark_us: int, last: bool = False) -> int:
        """Return the periods of a profile, 0 while the held events do not give them.

        1 where too many events do not follow the laser, or none do and these are the ``last``.
        """
        t = held.arrays[0]
        while True:
            while self._window is None:
                begin = self._seen
                window = estimation_window(t[begin:], watermark_us, self._modulation)
                if window is None and not last:
                    return 0
                self._seen = end = t.size if window is None else begin + window.size
                if self._is_lit(held, begin, end):
                    self._window = begin, end
                elif window is None or end > _HELD_EVENTS_MAX:
                    return 1
            first, begin = self._window
            end_us, events = int(t[begin - 1]), 0.0
            if last and t[-1] < end_us + self._span_us:
                # A short stream has no complete block.
                begin = first
            for enough in (EVENTS_WANTED, EVENTS_WANTED / 2.0):
                end_us = self._block_end_us(t, begin, end_us)
                if watermark_us <= end_us and not last:
                    return 0
                end = int(np.searchsorted(t, end_us))
                if self._is_lit(held, begin, end):
                    events = self._events(held, begin, end)
                if events >= enough:
                    return 1
                begin = end
            if events > 0.0 or last:
                break
            # The light was on for less than a window.
            self._seen, self._window = begin, None
        wanted = math.ceil(EVENTS_WANTED / max(events, 1e-9))
        return min(wanted, periods_max(self._modulation)) if events > 0.0 else 1

    def _block_end_us(self, t_us: NDArray[np.int64], begin: int, begin_us: int) -> int:
        """Return the end of the block that begins with an event and at a time."""
        end_us = begin_us + self._span_us
        if t_us.size > begin + _BLOCK_EVENTS:
            period_us = self._modulation.period_us
            periods = math.ceil((int(t_us[begin + _BLOCK_EVENTS]) - begin_us) / period_us)
            end_us = min(end_us, begin_us + round(max(periods, _BLOCK_PERIODS) * period_us))
        return end_us

    def _is_lit(self, held: HeldEvents, begin: int, end: int) -> bool:
        """Return true when held events follow the laser or are on a line."""
        if begin == end:
            return False
        sample = slice(begin, end, max((end - begin) // _SAMPLE, 1))
        t, x, y, p = (values[sample] for values in held.arrays)
        return estimate_phase(t, p, self._modulation).found or _is_line(x, y)

    def _events(self, held: HeldEvents, begin: int, end: int) -> float:
        """Return the events of a lit column in a period."""
        t_us, columns = (values[begin:end] for values in held.arrays[:2])
        turns = ((t_us - t_us[0]) / self._modulation.period_us).astype(np.int64)
        counts = np.bincount(columns).astype(np.float64)
        return (float(counts @ counts) / t_us.size - 1.0) / _participating(np.bincount(turns))


def _participating(counts: NDArray[np.int64]) -> float:
    """Return how many entries the counts are spread over: the number of equal ones."""
    total = float(counts.sum())
    return total * total / float(counts @ counts)


def _is_line(columns: NDArray[np.uint16], rows: NDArray[np.uint16]) -> bool:
    """Return true when the events of near columns are in few rows."""
    column, row = columns >> _CELL_BITS, rows >> _CELL_BITS
    cells = np.bincount(column.astype(np.int64) << _CELL_BITS * 2 | row)
    return _distinct(cells) < _LINE_CELLS_MAX * _distinct(np.bincount(column))


def _distinct(counts: NDArray[np.int64]) -> float:
    """Return the number of equally likely cells in which as many pairs of events would meet."""
    total = float(counts.sum())
    return total * (total - 1.0) / max(float(counts @ (counts - 1)), 1.0)
