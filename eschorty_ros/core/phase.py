"""Where modulation periods begin: exact edge times, trigger re-anchoring, phase from the events."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core._checks import TIME_LIMIT, exact, whole, whole_vector
from eschorty_ros.core._phase_kernels import (
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
from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation

EDGES_MAX = 1 << 14  # handed out per call; bounds the work between two looks at the events
JUMP_PERIODS = 4096  # longer gaps are jumped over instead of counted through
_HISTOGRAM_BINS = 200
_RAYLEIGH_MIN = 30.0
WINDOW_PERIODS = 4
WINDOW_EVENTS = 2048


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


@dataclass(frozen=True, slots=True)
class PhaseEstimate:
    """Rising edge seen in a window of events.

    Attributes
    ----------
    edge_us : int
        Sensor time of a rising edge within the window's first period, as the earliest events
        after it show it: late by the pixels' shortest latency.
    strength : float
        Vector strength of all events, 0 to 1 (ON events against the rising edge, OFF events
        against the falling one).
    rayleigh : float
        Strength squared times the number of events; exponential with mean 1 for unmodulated
        events.
    found : bool
        Whether the Rayleigh test calls the window modulated.
    """

    edge_us: int
    strength: float
    rayleigh: float
    found: bool


def estimate_phase(
    t_us: NDArray[np.int64], polarity: NDArray[np.uint8], modulation: Modulation
) -> PhaseEstimate:
    """Rising edge from a window of events, by circular statistics at the known frequency.

    ON events follow the rising edge and OFF events the falling one, so OFF events are turned back
    by the duty cycle and both vote for one direction. The burst's beginning, where the counts
    rise above the background, is taken as the edge.

    Parameters
    ----------
    t_us : ndarray of int64, shape (n,)
        In time order.
    polarity : ndarray of uint8, shape (n,)
        1 for ON.
    modulation : Modulation
        ``on_edge_us`` is not used.

    Returns
    -------
    PhaseEstimate

    Raises ``ArgumentError`` when there are no events, or they are not in time order.
    """
    t_us = whole_vector("t_us", t_us, np.int64, -TIME_LIMIT, TIME_LIMIT)
    fall = np.flatnonzero(np.diff(t_us) < 0)
    if fall.size:
        before, after = t_us[fall[0]], t_us[fall[0] + 1]
        raise ArgumentError(f"t_us goes from {before} to {after}; sort the events by time")
    polarity = whole_vector("polarity", polarity, np.uint8, 0, 1)
    if t_us.size == 0 or t_us.shape != polarity.shape:
        raise ArgumentError(
            f"t_us has {t_us.size} events and polarity {polarity.size}; give one polarity per event"
        )
    period_us = modulation.period_us
    origin = int(t_us[0])
    phase = (t_us - origin) / period_us
    phase -= np.where(polarity == 1, 0.0, modulation.duty)
    phase -= np.floor(phase)
    strength = float(abs(np.exp(2j * np.pi * phase).mean()))
    rayleigh = strength * strength * t_us.size
    begin = _burst_begin(phase)
    return PhaseEstimate(
        origin + round(begin * period_us), strength, rayleigh, rayleigh > _RAYLEIGH_MIN
    )


def _burst_begin(phase: NDArray[np.float64]) -> float:
    """Phase (0 to 1) at which the largest burst rises above the background."""
    bins = np.minimum((phase * _HISTOGRAM_BINS).astype(np.int64), _HISTOGRAM_BINS - 1)
    counts = np.bincount(bins, minlength=_HISTOGRAM_BINS).astype(np.float64)
    smooth = counts + np.roll(counts, 1) + np.roll(counts, -1)
    peak = int(np.argmax(smooth))
    background = float(np.quantile(counts, 0.2))
    level = background + 0.05 * (float(counts[peak]) - background)
    begin = peak
    for back in range(1, _HISTOGRAM_BINS // 2):
        if counts[(peak - back) % _HISTOGRAM_BINS] <= level:
            break
        begin = peak - back
    return (begin % _HISTOGRAM_BINS) / _HISTOGRAM_BINS


def decide_window(
    t_us: NDArray[np.int64], watermark_us: int, modulation: Modulation
) -> tuple[int, int] | None:
    """Leading events of one estimation window and its end (us), ``None`` while it is still open.

    A window is the fewest times ``WINDOW_PERIODS`` periods from the first event on that hold
    ``WINDOW_EVENTS`` events; only events decide it, not when they arrived.
    """
    t_us = exact("t_us", t_us, np.int64)
    whole("watermark_us", watermark_us, -TIME_LIMIT, TIME_LIMIT)
    if t_us.size < WINDOW_EVENTS:
        return None
    span_us = WINDOW_PERIODS * modulation.period_us
    first = int(t_us[0])
    pieces = int((int(t_us[WINDOW_EVENTS - 1]) - first) / span_us) + 1
    end_us = first + round(pieces * span_us)
    if watermark_us <= end_us:
        return None
    return int(np.searchsorted(t_us, end_us)), end_us
