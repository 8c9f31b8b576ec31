"""Compensation of the row's shift where the line straddles a reflectance step.

Rows on the brighter side of a step are lit further out than rows on the darker side, and the
centroid moves towards the brighter side by up to half the difference: 3.75 px from black to white
in the paper's Fig. 7. A single profile cannot distinguish this from a change of range. Its
neighbours can: before and after the step has crossed the beam the line is as wide as either side
alone makes it, and the width between shows how far the step has come. From which side it comes
depends on the stage's direction and on how the camera is mounted: the rows show it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.kernel import entry_kernel, kernel
from eschorty_ros.core.line import ROOT_12, events_per_row
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.profiles import LineRows
from eschorty_ros.core.reconstruction.settings import Settings

_LAG_MAX = 256
"""Most profiles held back; a beam that takes longer to cross is corrected in part."""

_WIDTH_GATE_PX = 3.0
"""Widths of the line that differ by less are taken as one reflectance."""

_ROW_GATE_PX = 6.0
"""Rows before and after that differ by more are two surfaces, not a step on one."""

_SIGMA_SHARE = 0.2
_SIGMA_PX = 0.35
"""Standard deviation of a correction: a share of it, and what half the error of a width gives."""

_REACH_COLUMNS = 2
"""Columns on either side that the median of the widths takes in."""

_EVIDENCE_KEPT = 0.7
"""Share of the evidence for the side that the next profile with a step keeps: a stage may turn."""

_SURE = 5.0
"""Standard deviations of the evidence against the stated direction from which on it is wrong."""


class _History(NamedTuple):
    """The newest profiles, one per line of the arrays, at their number modulo the size."""

    present: NDArray[np.bool_]
    widths_px: Array
    medians_px: Array
    rows: Array


class _Points(NamedTuple):
    """Points of one profile: how many profiles before and after it a step is off the line.

    ``shift_px`` is by the widths, 0 without a step, and ``difference_px`` by the rows.
    """

    column: NDArray[np.uint16]
    lag: NDArray[np.int64]
    shift_px: Array
    difference_px: Array


class StepCompensator:
    """Corrects a stream of profiles; holds back as many as a step takes to cross the beam.

    - ``settings``: ``stage_speed_mm_s`` gives the speed, and by its sign the direction of the
      surface, unless the rows show another one.

    Public attributes:
    - ``columns_compensated``: Points whose row was corrected.
    """

    def __init__(self, settings: Settings, model: RangeModel, modulation: Modulation) -> None:
        self.columns_compensated = 0
        self._model = model
        self._every = settings.periods_per_profile
        # The stage carries the instrument towards +y, and +y appears at lower rows.
        self._sign = -math.copysign(1.0, settings.stage_speed_mm_s)
        self._evidence = np.zeros(2)
        step_mm = abs(settings.stage_speed_mm_s) * modulation.period_us * 1e-6 * self._every
        self._crossing_mm_px = settings.line_width_px / max(step_mm, 1e-9)
        far_mm = model.range_limits_mm[1]
        self._delay = int(self._lags(np.array([far_mm if math.isfinite(far_mm) else 1e6]))[0])
        size = 2 * self._delay + 1
        self._history = _History(
            present=np.zeros(size, np.bool_),
            widths_px=np.zeros((size, model.columns)),
            medians_px=np.zeros((size, model.columns)),
            rows=np.full((size, model.columns), np.nan),
        )
        self._events_per_row = np.full(size, np.nan)
        self._held: list[tuple[int, LineRows]] = []
        self._newest = -1
        self._last_index: int | None = None

    def push(self, rows: LineRows) -> LineRows:
        """Return the corrected profiles whose neighbours are known by now.

        - ``rows``: Complete profiles, in order.
        """
        starts = np.flatnonzero(np.diff(rows.period, prepend=-1 - rows.period[:1]))
        done = []
        for begin, end in pairwise([*starts.tolist(), len(rows)]):
            self._enter(rows.select(slice(begin, end)))
            done += self._release(self._newest - self._delay)
        return LineRows.concatenate(done)

    def flush(self) -> LineRows:
        """Return the profiles held back; points without later neighbours are unchanged."""
        return LineRows.concatenate(self._release(self._newest))

    def _enter(self, profile: LineRows) -> None:
        """Store the widths and rows of one profile at its place in time."""
        from scipy.ndimage import median_filter

        index = int(profile.period[0]) // self._every
        passed = 1 if self._last_index is None else index - self._last_index
        self._last_index = index
        history = self._history
        size = history.present.size
        # A number that does not grow is a new grid: no profile before it is a neighbour.
        passed = passed if 0 < passed < size else size
        skipped = (self._newest + 1 + np.arange(passed)) % size
        history.present[skipped] = False
        self._events_per_row[skipped] = np.nan
        self._newest += passed
        slot = self._newest % size
        history.present[slot] = True
        self._events_per_row[slot] = events_per_row(profile.width_px, profile.events)
        widths_px, line = history.widths_px[slot], history.rows[slot]
        widths_px[:], line[:] = 0.0, np.nan
        widths_px[profile.column] = self._full_width_px(profile)
        line[profile.column] = profile.row
        # Columns without a point count as 0.
        around = 2 * _REACH_COLUMNS + 1
        history.medians_px[slot] = median_filter(widths_px, around, mode="nearest")
        self._held.append((self._newest, profile))

    def _full_width_px(self, profile: LineRows) -> Array:
        """Return the full widths of the lit rows, 1 px at least.

        The smaller of what the rows' spread and the events' number give: a gap between two lit
        parts widens the spread, and so does background; a refractory time distorts the number.
        """
        width_px = ROOT_12 * profile.width_px
        known = self._events_per_row[np.isfinite(self._events_per_row)]
        if known.size:
            # Over many profiles: in a single one every column may straddle a step.
            width_px = np.minimum(width_px, profile.events / np.median(known))
        return np.maximum(width_px, 1.0)

    def _release(self, until: int) -> list[LineRows]:
        done = []
        while self._held and self._held[0][0] <= until:
            done.append(self._corrected(*self._held.pop(0)))
        return done

    def _corrected(self, number: int, profile: LineRows) -> LineRows:
        lag = self._lags(self._model.range_mm(profile.row, profile.column))
        shift_px, difference_px = np.zeros((2, len(profile)))
        points = _Points(profile.column, lag, shift_px, difference_px)
        _shifts(points, self._history, number, self._newest)
        if not shift_px.any():
            return profile
        product = np.nan_to_num(self._sign * shift_px * difference_px)
        self._evidence = _EVIDENCE_KEPT * self._evidence + (product.sum(), product @ product)
        total, variance = self._evidence.tolist()
        shift_px *= -self._sign if total < -_SURE * math.sqrt(variance) else self._sign
        # Not where it would not bring a point nearer to its neighbours.
        shift_px[np.abs(difference_px - shift_px) > np.abs(difference_px)] = 0.0
        moved = shift_px != 0.0
        self.columns_compensated += int(np.count_nonzero(moved))
        added_px = np.where(moved, np.hypot(_SIGMA_PX, _SIGMA_SHARE * shift_px), 0.0)
        # Sigma may have what the edge moves the line by, which is taken off.
        left2 = np.maximum(profile.sigma_row**2 - shift_px**2, 0.0)
        return replace(profile, row=profile.row - shift_px, sigma_row=np.sqrt(left2 + added_px**2))

    def _lags(self, range_mm: Array) -> NDArray[np.int64]:
        """Return the number of profiles in which a step at the middle of the line leaves it."""
        rows_per_mm = self._model.rows_per_mm_off_sheet(range_mm)
        profiles = np.nan_to_num(self._crossing_mm_px / np.maximum(rows_per_mm, 1e-9), nan=1.0)
        return np.clip(np.ceil(profiles), 1, _LAG_MAX).astype(np.int64)


@kernel
def _centroid_shift(before, now, after):
    """Return the shift of the line's centroid towards the rows from which the surface comes, px.

    The arguments are full widths of the lit rows on the surface before the step, across it and
    after it. The wider side shows ``low / 2 + half`` rows on one side of the centre, the other
    ``low / 2``. As the step crosses, rows of the wider side first appear beyond a gap, then
    replace dark rows, then lit ones (no change of width), and at last the narrower side's rows go.
    """
    low = min(before, after)
    high = max(before, after)
    extra = min(max(now - low, 0.0), high - low)
    if extra == 0.0:
        size = 0.0
    elif 2.0 * extra <= high - low:
        size = extra * (high - extra) / (2.0 * now)
    else:
        size = 0.5 * (high - low - extra)
    return size if after >= before else -size


@kernel
def _between(row_before, row_after):
    """Return the mean row of two neighbours in time, or that of the only one; NaN without any."""
    if np.isnan(row_before):
        return row_after
    if np.isnan(row_after):
        return row_before
    return 0.5 * (row_before + row_after)


@entry_kernel
def _shifts(points, history, number, newest):
    """Write the shift and the difference of each point of profile ``number``.

    The shift is positive towards the rows from which the surface comes, and 0 where a neighbour is
    missing; the difference from the neighbours is NaN where they have no row.
    """
    size = history.present.size
    present = number % size
    for k in range(points.column.size):
        column = np.int64(points.column[k])
        first, last = number - points.lag[k], number + points.lag[k]
        if first <= newest - size or last > newest:
            continue
        before, after = first % size, last % size
        if not (history.present[before] and history.present[after]):
            continue
        width_before = history.medians_px[before, column]
        width_after = history.medians_px[after, column]
        if abs(width_after - width_before) < _WIDTH_GATE_PX:
            continue
        row_before, row_after = history.rows[before, column], history.rows[after, column]
        if abs(row_before - row_after) > _ROW_GATE_PX:
            continue
        around = slice(max(column - _REACH_COLUMNS, 0), column + _REACH_COLUMNS + 1)
        near = history.widths_px[present, around]
        width = np.median(near[near > 0.0])
        shift = _centroid_shift(width_before, width, width_after)
        points.shift_px[k] = shift
        expected = _between(row_before, row_after)
        points.difference_px[k] = history.rows[present, column] - expected
