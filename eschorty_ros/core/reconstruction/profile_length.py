"""How many periods make a profile: as many as give a column enough events for a point."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.line import TIME_LIMIT_US
from eschorty_ros.core.line.blinking import PERIOD_MIN_US, STRENGTH_MIN
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.held_events import HELD_EVENTS_MAX, HeldEvents, sample
from eschorty_ros.core.modulation.phase_estimate import (
    estimate_phase,
    estimation_window,
    line_phase,
)
from eschorty_ros.core.modulation.phase_lock import BLOCK_US

_PERIODS_MAX = 1000
EVENTS_WANTED = 16
"""Events per column and profile that a point should have."""
_BLOCK_PERIODS = 2
_PERIODS_MIN = 4
# As many show whether the rows of successive periods differ, where pixels or the readout are slower
# than these.
_SHORT_PERIODS_MIN = 16
# Numbers of periods that are compared, and the variance over the least one that differs from it.
_CANDIDATES_MAX = 32
_UNEVEN_ROWS = 1.5
_BLOCK_EVENTS = 1 << 16
FEW_SHARE = 1.0 / 24.0
"""Part of the columns that may have few events."""
# Standard deviation of the events of even profiles over their mean, and their number to know it.
_UNEVEN_SHARE = 0.2
_PROFILES_MIN = 4
# Part of the events of the fullest period that periods in the dark do not reach.
_LIT_SHARE = 0.125
# Events of a window that are looked at, evenly spread.
_SAMPLE = 1 << 16
# Cells of 16 x 16 pixels: a line is in one to four of a column's 45, background in all.
_CELL_BITS = 4
_LINE_CELLS_MAX = 8.0


def periods_max(modulation: Modulation) -> int:
    """Return the most periods of a profile: the time within it is limited."""
    return min(_PERIODS_MAX, math.ceil(TIME_LIMIT_US / modulation.period_us) - 2)


class ProfileLength:
    """Chooses the periods of a profile from the first events that follow the laser.

    The events counted are those of one block. It begins after the first estimation window that is
    modulated, or that shows a line where pixels are too slow for the modulation: the choice does
    not depend on how the stream is split, nor on the background before the laser is on. A column
    counts by its pairs of events, which background has few of. One period is a profile where it has
    half of `EVENTS_WANTED`: of Poisson counts with a mean of 8, one in 24 is less than 4, the
    default of ``events_min``. A column counts from its first period with events to its last one, as
    surfaces begin and end. Else, or where periods are not even and more columns have less, a
    profile has as many periods as give `EVENTS_WANTED`, or the next number with which profiles are
    even: pixels that follow every third period give most events in two of three, and in periods
    shorter than a readout or a refractory time not those of the same rows. Where one period
    is not enough in the first block, with twice as many events, the next one counts, since pixels
    give more when the laser is switched on. Blocks without light do not count. A block has
    `BLOCK_US`, but two periods at least; the first one ends with enough events after four.

    Public attributes:
    - ``window``: First and last of the held events that showed the laser, ``None`` before.
    - ``fills_columns``: True where most of these, or of the first, follow the laser and are on no
      line.
    """

    def __init__(self, modulation: Modulation) -> None:
        self._modulation = modulation
        self._span_us = max(BLOCK_US, round(_BLOCK_PERIODS * modulation.period_us))
        self._seen = 0
        self.window: tuple[int, int] | None = None
        self.fills_columns = False

    def choose(self, held: HeldEvents, watermark_us: int, last: bool = False) -> int:
        """Return the periods of a profile, 0 while the held events do not give them.

        1 where none follow the laser and these are the ``last``. Where too many do not, 1 if the
        phase is known, as they can be assigned; else they are dropped.
        """
        periods = None
        while periods is None:
            periods = self._find_window(held, watermark_us, last)
            if periods is None:
                periods = self._of_blocks(held, watermark_us, last)
        return periods

    def _find_window(self, held: HeldEvents, watermark_us: int, last: bool) -> int | None:
        """Find the estimation window that follows the laser or shows a line, and return ``None``.

        Where there is none, return what `choose` does.
        """
        while self.window is None:
            t, begin = held.arrays[0], self._seen
            window = estimation_window(t[begin:], watermark_us, self._modulation)
            if window is None and not last:
                return 0
            self._seen = end = t.size if window is None else begin + window.size
            found = self._edge_us(held, begin, end) is not None
            if found or begin == 0:
                self.fills_columns = self._is_everywhere(held, begin, end)
            if found:
                self.window = begin, end
                break
            if window is None:
                return 1
            if begin == held.searched and end - begin < 2 * _SAMPLE:
                # All its events were looked at: the phase lock would find no more in them.
                held.searched = end
            if end > HELD_EVENTS_MAX:
                if self._modulation.on_edge_us is not None:
                    return 1
                held.refuse(end)
                self._seen = 0
                if len(held) == 0:
                    return 0
        return None

    def _of_blocks(self, held: HeldEvents, watermark_us: int, last: bool) -> int | None:
        """Return the periods of a profile by the blocks after the window, 0 before their end.

        Where these have no light, drop the window and return ``None``.
        """
        assert self.window is not None
        t, period_us = held.arrays[0], self._modulation.period_us
        first, begin = self.window
        end_us, periods = int(t[begin - 1]), 0
        block: tuple[Array, NDArray[np.uint16], NDArray[np.uint16]] | None = None
        if last and t[-1] < end_us + self._span_us:
            # A short stream has no complete block. Of a long time with few events the end counts.
            most_us = _PROFILES_MIN * periods_max(self._modulation) * period_us
            begin = max(first, int(np.searchsorted(t, t[-1] - most_us)))
        for enough in (EVENTS_WANTED, EVENTS_WANTED // 2):
            end_us = self._block_end_us(t, begin, end_us, block is None)
            if watermark_us <= end_us and not last:
                return 0
            end = int(np.searchsorted(t, end_us))
            edge_us = self._edge_us(held, begin, end)
            if edge_us is not None and edge_us <= t[end - 1]:
                after = int(np.searchsorted(t, edge_us))
                t_us, columns, rows = (values[after:end] for values in held.arrays[:3])
                block = (t_us - edge_us) / period_us, columns, rows
            if block is not None:
                periods = self._periods(*block, enough)
            if periods == 1:
                return 1
            begin = end
        if periods > 0 or last:
            return max(periods, 1)
        # The light was on for less than a window.
        self._seen, self.window = begin, None
        return None

    def _block_end_us(self, t_us: NDArray[np.int64], begin: int, begin_us: int, short: bool) -> int:
        """Return the end of the block that begins with an event and at a time."""
        end_us = begin_us + self._span_us
        if short and t_us.size > begin + _BLOCK_EVENTS:
            period_us = self._modulation.period_us
            periods = math.ceil((int(t_us[begin + _BLOCK_EVENTS]) - begin_us) / period_us)
            least = _SHORT_PERIODS_MIN if period_us < PERIOD_MIN_US else _PERIODS_MIN
            end_us = min(end_us, begin_us + round(max(periods, least) * period_us))
        return end_us

    def _edge_us(self, held: HeldEvents, begin: int, end: int) -> int | None:
        """Return an edge of the laser that held events follow, or are on a line; else none."""
        if begin == end:
            return None
        events = sample([values[begin:end] for values in held.arrays], _SAMPLE)
        phase = line_phase(events, self._modulation)
        return phase.edge_us if phase.found or _is_line(*events[1:3]) else None

    def _is_everywhere(self, held: HeldEvents, begin: int, end: int) -> bool:
        """Return whether events of a window follow the laser and are in many rows of a column.

        Those of its fullest period do not show it: all pixels of a camera that starts fire once.
        """
        if begin == end:
            return False
        events = sample([values[begin:end] for values in held.arrays], _SAMPLE)
        turns = ((events[0] - events[0][0]) / self._modulation.period_us).astype(np.int64)
        others = turns != np.bincount(turns).argmax()
        t_us, columns, rows, polarity = (values[others] for values in events)
        if not t_us.size or _is_line(columns, rows):
            return False
        return estimate_phase(t_us, polarity, self._modulation).strength > STRENGTH_MIN

    def _periods(
        self, turns: Array, columns: NDArray[np.uint16], rows: NDArray[np.uint16], enough: int
    ) -> int:
        """Return the periods of a profile; one where a column has ``enough`` events in a period.

        ``turns`` are the times of the events since an edge, periods.
        """
        shape = int(turns[-1]) + 1, int(columns.max()) + 1
        index = turns.astype(np.int64) * shape[1] + columns
        size = shape[0] * shape[1]
        counts = np.bincount(index, minlength=size).reshape(shape)
        sums = np.bincount(index, rows, size).astype(np.float64).reshape(shape)
        # The last period may not be whole.
        counts = counts[: max(round(float(turns[-1])), 1)]
        # The laser may be on for a part of the block.
        in_period = counts.sum(axis=1)
        lit = np.flatnonzero(in_period >= _LIT_SHARE * in_period.max())
        on = slice(lit[0], lit[-1] + 1)
        counts, sums, in_period = counts[on], sums[on], in_period[on]
        of_column = counts.sum(axis=0)
        pairs = of_column * (of_column - 1)
        weights = pairs / max(pairs.sum(), 1)
        seen = _between_events(counts)
        weights /= np.maximum(seen.sum(axis=0), 1)
        events = max(float(of_column @ weights), 1e-9)
        few = (seen & (counts < EVENTS_WANTED // 4)).sum(axis=0) @ weights
        wanted = 1
        if events < enough or (few > FEW_SHARE and not _are_even(in_period, 1)):
            wanted = max(min(math.ceil(EVENTS_WANTED / events), periods_max(self._modulation)), 2)
        longer = range(wanted, len(counts) // _PROFILES_MIN + 1)
        even = [periods for periods in longer if wanted == 1 or _are_even(in_period, periods)]
        if self._modulation.period_us < PERIOD_MIN_US:
            even = _with_even_rows(even, counts, sums)
        return next(iter(even), wanted)


def _between_events(counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the periods from the first to the last in which a column has events."""
    some = counts > 0
    later = np.logical_or.accumulate(some[::-1])[::-1]
    return np.logical_or.accumulate(some) & later


def _are_even(in_period: NDArray[np.int64], periods: int) -> bool:
    """Return whether profiles of ``periods`` have about the same number of events."""
    whole = in_period[: len(in_period) // periods * periods]
    profiles = whole.reshape(-1, periods).sum(axis=1)
    return bool(profiles.std() <= _UNEVEN_SHARE * profiles.mean())


def _with_even_rows(candidates: list[int], counts: NDArray[np.int64], sums: Array) -> list[int]:
    """Return those periods of a profile with which rows scatter about as little as with others.

    Their variance times the periods is the same where all periods show the same rows.
    """
    candidates = candidates[:_CANDIDATES_MAX]
    scatter = [periods * _row_variance(counts, sums, periods) for periods in candidates]
    if not np.isfinite(scatter).any():
        return candidates
    most = _UNEVEN_ROWS * np.nanmin(scatter)
    return [periods for periods, own in zip(candidates, scatter, strict=True) if own <= most]


def _row_variance(counts: NDArray[Any], sums: Array, periods: int) -> float:
    """Return the variance of rows from one profile of ``periods`` to the next, NaN of none."""
    shape = len(counts) // periods, periods, -1
    whole = slice(shape[0] * periods)
    number, total = (values[whole].reshape(shape).sum(axis=1) for values in (counts, sums))
    known = number.min(axis=0) >= EVENTS_WANTED // 4
    if not known.any():
        return math.nan
    differences = np.diff(total[:, known] / number[:, known], axis=0)
    return float(np.mean(differences * differences))


def _is_line(columns: NDArray[np.uint16], rows: NDArray[np.uint16]) -> bool:
    """Return whether the events of near columns are in few rows."""
    column, row = columns >> _CELL_BITS, rows >> _CELL_BITS
    cells = np.bincount(column.astype(np.int64) << _CELL_BITS * 2 | row)
    return _distinct(cells) < _LINE_CELLS_MAX * _distinct(np.bincount(column))


def _distinct(counts: NDArray[np.int64]) -> float:
    """Return the number of equally likely cells in which as many pairs of events would meet."""
    total = float(counts.sum())
    return total * (total - 1.0) / max(float(counts @ (counts - 1)), 1.0)
