"""Where modulation periods begin: exact edge times, anchored anew by triggers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import TIME_LIMIT, exact, whole
from eschorty_ros.core.modulation._phase import (
    C_BRIDGED,
    COUNTERS,
    S_ANCHOR,
    S_INDEX,
    S_LAST,
    S_MISSED,
    S_REST,
    S_SIZE,
    S_STEP,
    S_TRIGGERED,
    S_WHOLE,
    TOLERANCE_SHARE,
    _schedule,
)
from eschorty_ros.core.modulation.modulation import Modulation

EDGES_MAX = 1 << 14  # handed out per call; bounds the work between two looks at the events
JUMP_PERIODS = 4096  # longer gaps are jumped over instead of counted through


class EdgeSchedule:
    """Rising edges of one modulation, in order, each decided exactly once.

    Edge ``k`` after an anchor lies at ``anchor + round(k / f)`` with the quotient exact (Python
    integers to jump, an integer remainder to step), so no error grows with time or index.

    Parameters
    ----------
    modulation : Modulation
    every : int
        Hand out each ``every``-th edge only.

    Notes
    -----
    A rising trigger within a quarter of a period of the predicted edge takes its place and
    becomes the new anchor. A missing one is bridged by the prediction, which is only certain when
    that quarter has passed. Triggers elsewhere are counted as spurious, unless three edges in a
    row went missing: then the next trigger sets the phase anew. Events are never assigned to a
    period before its limits are certain, so the result does not depend on when data arrive.
    """

    def __init__(self, modulation: Modulation, every: int = 1) -> None:
        whole("every", every, 1, 1 << 31)
        period = 1_000_000 / Fraction(modulation.frequency_hz)
        self.period = period
        self._denominator = period.denominator
        self._step, self._part = divmod(period.numerator, period.denominator)
        self._every = every
        self._state = np.zeros(S_SIZE, dtype=np.int64)
        self._counts = np.zeros(len(COUNTERS), dtype=np.int64)
        self._edges = np.empty(EDGES_MAX, dtype=np.int64)
        self._indices = np.empty(EDGES_MAX, dtype=np.int64)
        self._triggers = np.empty(0, dtype=np.int64)
        self.anchored = False
        self.safe_us = 0
        self.periods_jumped = 0

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return dict(zip(COUNTERS, self._counts.tolist(), strict=True))

    @property
    def first_trigger_us(self) -> int | None:
        """Earliest trigger not used yet."""
        return int(self._triggers[0]) if self._triggers.size else None

    @property
    def triggered(self) -> bool:
        """Whether triggers set the edges."""
        return bool(self._state[S_TRIGGERED])

    @property
    def last_us(self) -> int:
        """Time of the last edge handed out or skipped."""
        return int(self._state[S_LAST])

    def middle_after(self, multiple: int) -> int:
        """Middle of the period that begins with the next edge whose index is a multiple."""
        whole("multiple", multiple, 1, 1 << 31)
        ahead = multiple - int(self._state[S_INDEX]) % multiple
        step = int(self._state[S_STEP]) + ahead
        return int(self._state[S_ANCHOR]) + round(step * self.period) + self._step // 2

    def shift(self, by_us: int) -> None:
        """Move all edges not handed out yet by less than half a period."""
        half_us = (self._step + 1) // 2
        self._state[S_ANCHOR] += whole("by_us", by_us, -half_us, half_us)

    def add_triggers(self, t_us: NDArray[np.int64]) -> None:
        """Append rising edges of the trigger input, in time order."""
        if exact("t_us", t_us, np.int64).size:
            self._triggers = np.concatenate([self._triggers, t_us])

    def anchor(self, edge_us: int, start_us: int) -> None:
        """Fix the phase: one edge at ``edge_us``; the first one out is the last until ``start_us``.

        With ``every`` > 1 it is the last one whose index is a multiple of it.
        """
        for name, time_us in (("edge_us", edge_us), ("start_us", start_us)):
            whole(name, time_us, -TIME_LIMIT, TIME_LIMIT)
        self._state[:] = 0
        self._state[S_ANCHOR] = edge_us
        step = self._step_at(start_us)
        self._seek((step // self._every) * self._every - 1)
        self.anchored = True

    def jump(self, t_us: int) -> None:
        """Skip whole profiles that end before ``t_us`` when there are very many of them.

        Call with the time of the next event to be assigned.
        """
        target = whole("t_us", t_us, -TIME_LIMIT, TIME_LIMIT)
        if self._triggers.size:
            target = min(target, int(self._triggers[0]))
        state = self._state
        if target - int(state[S_LAST]) <= JUMP_PERIODS * self.period:
            return
        # The edge of the profile that holds the target is still to come.
        step = self._step_at(target) - 1 - self._every
        skipped = step - int(state[S_STEP])
        skipped -= skipped % self._every
        if skipped <= 0:
            return
        self.periods_jumped += skipped // self._every
        if state[S_TRIGGERED]:
            state[S_MISSED] += skipped
            self._counts[C_BRIDGED] += skipped
        self._seek(int(state[S_STEP]) + skipped)

    def watermark_after(self, newest_us: int) -> int:
        """Watermark that makes everything up to ``newest_us`` certain, and nothing later."""
        whole("newest_us", newest_us, -TIME_LIMIT, TIME_LIMIT)
        waits = int(self._state[S_TRIGGERED]) * max((self._step + 1) // TOLERANCE_SHARE, 1)
        return newest_us + 1 + waits

    def advance(self, watermark_us: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Edges certain now and their indices: views valid until the next call.

        ``safe_us`` is set to the time before which events may be assigned. When ``EDGES_MAX`` edges
        come back there may be more: assign the events, then call again.
        """
        whole("watermark_us", watermark_us, -TIME_LIMIT, TIME_LIMIT)
        n, used, safe = _schedule(
            self._state,
            self._step,
            self._part,
            self._denominator,
            self._every,
            self._triggers,
            0,
            watermark_us,
            self._edges,
            self._indices,
            self._counts,
        )
        if used:
            self._triggers = self._triggers[used:]
        self.safe_us = int(safe)
        return self._edges[:n], self._indices[:n]

    def _step_at(self, t_us: int) -> int:
        """Count edges from the anchor to the last one at or before ``t_us``."""
        elapsed = t_us - int(self._state[S_ANCHOR])
        step = int(elapsed / self.period) + 1
        while round(step * self.period) > elapsed:
            step -= 1
        return step

    def _seek(self, step: int) -> None:
        """Make ``step`` the last edge handed out."""
        state = self._state
        whole, rest = divmod(step * self.period.numerator, self._denominator)
        state[S_INDEX] += step - int(state[S_STEP])
        state[S_STEP], state[S_WHOLE], state[S_REST] = step, whole, rest
        state[S_LAST] = int(state[S_ANCHOR]) + round(step * self.period)
