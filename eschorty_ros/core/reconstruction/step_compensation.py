"""Takes out the shift of the centroid where the line straddles a reflectance step.

Rows on the brighter side of a step are lit further out than rows on the darker side, and the
centroid moves towards the brighter side by up to half the difference: 2.9 px from black to white
(the paper's Fig. 7). A single profile does not tell this from a change of range. Its neighbours
do: before and after the step has crossed the beam the line is as wide as either side alone makes
it, the width between says how far the step has come, and the motion says from where.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.line import ROOT_12, events_per_row
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction._step import _middles, _step_shifts
from eschorty_ros.core.reconstruction.profiles import LineRows
from eschorty_ros.core.reconstruction.settings import Settings

LAG_MAX = 256
"""Most profiles held back; a beam that takes longer to cross is corrected in part."""

_WIDTH_GATE_PX = 3.0
"""Widths of the line that differ by less are taken as one reflectance."""

_ROW_GATE_PX = 6.0
"""Rows before and after that differ by more are two surfaces, not a step on one."""

_AHEAD_SHARE = 0.8
"""Part of the line's width to look ahead: what is left shifts little, and holding back costs."""

_SIGMA_SHARE = 0.2
_SIGMA_PX = 0.3
"""Standard deviation of a correction: a share of it, and what half the error of a width gives."""


class StepCompensator:
    """Corrects profiles as they stream by; holds back as many as cross the beam.

    Parameters
    ----------
    settings : Settings
        ``stage_speed_mm_s`` gives the speed and, by its sign, the direction of the surface.
    model : RangeModel
    modulation : Modulation
    """

    def __init__(self, settings: Settings, model: RangeModel, modulation: Modulation) -> None:
        self._model = model
        self._every = settings.periods_per_profile
        # The stage carries the instrument towards +y, and +y appears at lower rows.
        self._sign = -math.copysign(1.0, settings.stage_speed_mm_s)
        step_mm = abs(settings.stage_speed_mm_s) * modulation.period_us * 1e-6 * self._every
        self._crossing_mm_px = settings.line_width_px / max(step_mm, 1e-9)
        back, ahead = self._lags(np.array([self._farthest_mm()]))
        self.delay = int(ahead[0])
        size = int(back[0] + ahead[0]) + 1
        self._present = np.zeros(size, dtype=np.bool_)
        self._widths = np.zeros((size, model.columns))
        self._middles = np.zeros((size, model.columns))
        self._rows = np.full((size, model.columns), np.nan)
        self._per_row = np.full(size, np.nan)
        self._held: list[tuple[int, LineRows]] = []
        self._newest = -1
        self._last_index: int | None = None
        self._scratch = np.empty(5)
        self.columns_compensated = 0

    def push(self, profiles: LineRows) -> LineRows:
        """Take whole profiles; returns the corrected ones whose neighbours are known by now."""
        starts = np.flatnonzero(np.diff(profiles.period, prepend=-1 - profiles.period[:1]))
        bounds = [*starts.tolist(), len(profiles)]
        done = []
        for begin, end in pairwise(bounds):
            self._enter(profiles.select(slice(begin, end)))
            done += self._release(self._newest - self.delay)
        return LineRows.concatenate(done)

    def flush(self) -> LineRows:
        """LineRows still held back; a point whose later neighbours are missing stays as it is."""
        return LineRows.concatenate(self._release(self._newest))

    def _enter(self, profile: LineRows) -> None:
        """Store one profile's widths and rows at its place in time."""
        index = int(profile.period[0]) // self._every
        passed = 1 if self._last_index is None else index - self._last_index
        self._last_index = index
        size = self._present.size
        # A number that does not grow is a new grid: nothing before it is a neighbour.
        passed = passed if 0 < passed < size else size
        for skipped in range(passed):
            slot = (self._newest + 1 + skipped) % size
            self._present[slot] = False
            self._per_row[slot] = np.nan
        self._newest += passed
        slot = self._newest % size
        self._present[slot] = True
        self._per_row[slot] = events_per_row(profile.width_px, profile.events)
        widths, line = self._widths[slot], self._rows[slot]
        widths[:], line[:] = 0.0, np.nan
        widths[profile.column] = self._full_width(profile)
        line[profile.column] = profile.row
        _middles(widths, self._scratch, self._middles[slot])
        self._held.append((self._newest, profile))

    def _full_width(self, profile: LineRows) -> NDArray[np.float64]:
        """Full widths of the lit rows: the smaller of what spread and counts say, 1 px at least.

        A gap between two lit parts widens the spread, and so does background; a refractory time
        distorts the counts.
        """
        width = ROOT_12 * profile.width_px
        known = self._per_row[np.isfinite(self._per_row)]
        if known.size:
            # Over many profiles: in a single one every column may straddle a step.
            width = np.minimum(width, profile.events / np.median(known))
        return np.maximum(width, 1.0)

    def _release(self, until: int) -> list[LineRows]:
        done = []
        while self._held and self._held[0][0] <= until:
            done.append(self._corrected(*self._held.pop(0)))
        return done

    def _corrected(self, place: int, profile: LineRows) -> LineRows:
        shift = np.empty(len(profile))
        _step_shifts(
            profile.column,
            *self._lags(self._model.range_mm(profile.row, profile.column)),
            self._widths,
            self._middles,
            self._rows,
            self._present,
            self._newest,
            place,
            self._sign,
            _WIDTH_GATE_PX,
            _ROW_GATE_PX,
            self._scratch,
            shift,
        )
        moved = shift != 0.0
        if not moved.any():
            return profile
        self.columns_compensated += int(np.count_nonzero(moved))
        added = np.where(moved, np.hypot(_SIGMA_PX, _SIGMA_SHARE * shift), 0.0)
        return replace(
            profile,
            row=profile.row - self._sign * shift,
            sigma_row=np.hypot(profile.sigma_row, added),
        )

    def _lags(self, range_mm: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """LineRows back and ahead until a step at the middle of the line has left it."""
        rows_per_mm = self._model.rows_per_mm_off_sheet(range_mm)
        profiles = np.nan_to_num(self._crossing_mm_px / np.maximum(rows_per_mm, 1e-9), nan=1.0)
        back = np.clip(np.ceil(profiles), 1, LAG_MAX).astype(np.int64)
        ahead = np.clip(np.rint(_AHEAD_SHARE * profiles), 1, LAG_MAX).astype(np.int64)
        return back, ahead

    def _farthest_mm(self) -> float:
        far_mm = self._model.range_limits_mm[1]
        return far_mm if math.isfinite(far_mm) else 1e6
