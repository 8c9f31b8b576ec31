"""Beginnings of modulation periods: exact edge times, re-anchored by triggers."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import entry_kernel, kernel
from eschorty_ros.core.modulation.modulation import Modulation

EDGES_MAX = 1 << 14
"""Most edges per call; bounds the memory between two batches of events."""

_JUMP_PERIODS = 4096  # longer gaps are skipped in one step
_TOLERANCE_SHARE = 4  # a trigger belongs to an edge within this part of the period
_MISSING_SHARE = Fraction(1, 4)  # of a first profile that may be missing
_MISSED_MAX = 3  # after as many edges without a trigger two triggers set a new phase
_NO_TRIGGER_US = -(1 << 61)


class _State(NamedTuple):
    """The last edge: ``step`` periods after the anchor, ``elapsed_us`` and a remainder.

    ``lone_us`` is the last trigger that set no edge, for the next one to agree with.
    """

    anchor_us: int = 0
    step: int = 0
    elapsed_us: int = 0
    remainder: int = 0
    number: int = 0
    last_us: int = 0
    triggered: bool = False
    missed: int = 0
    lone_us: int = _NO_TRIGGER_US


class _Counts(NamedTuple):
    triggers_used: int = 0
    triggers_spurious: int = 0
    edges_bridged: int = 0
    phase_locks: int = 0


class _Period(NamedTuple):
    """Length of the period, ``quotient + remainder / denominator`` us, and the edges to keep."""

    quotient_us: int
    remainder: int
    denominator: int
    every: int


class EdgesAhead(NamedTuple):
    """Edges that are certain, their indices and the time before which events can be assigned."""

    edges_us: NDArray[np.int64]
    indices: NDArray[np.int64]
    safe_us: int


class _Advance(NamedTuple):
    """Numbers of new edges and used triggers, the time before which events can be assigned.

    ``state`` and ``counts`` are those of the next call.
    """

    edges: int
    triggers: int
    safe_us: int
    state: tuple[Any, ...]
    counts: tuple[int, ...]


class EdgeSchedule:
    """Rising edges of one modulation, in order, each decided exactly once.

    Edge ``k`` after an anchor is at ``anchor + round(k / f)`` with the quotient exact (Python
    integers to jump, an integer remainder to step), so no error grows with time or index.

    A rising trigger within a quarter of a period of the predicted edge replaces it and becomes the
    new anchor. Where a trigger is missing the prediction is used, but only after that quarter has
    passed. Triggers elsewhere are counted as spurious. At first, and where three edges in a row
    went missing, two successive triggers set the phase that are one or two periods apart: the laser
    sends more than one, a motor's noise on an open input does not repeat at its period. Events are
    never assigned to a period before its limits are certain, so the result does not depend on when
    data arrive.

    - ``every``: Return only each ``every``-th edge; 0 while that is not known, until ``anchor``.

    Public attributes:
    - ``anchored``: True when the phase is fixed.
    - ``safe_us``: Time before which events can be assigned to periods.
    - ``periods_jumped``: Profiles without events that :meth:`jump` has skipped.
    """

    def __init__(self, modulation: Modulation, every: int = 1) -> None:
        self._period = 1_000_000 / Fraction(modulation.frequency_hz)
        numerator, denominator = self._period.as_integer_ratio()
        self._parts = _Period(*divmod(numerator, denominator), denominator, every)
        self._state = _State()
        self._counts = _Counts()
        self._edges_us, self._indices = np.empty((2, EDGES_MAX), np.int64)
        self._triggers_us = np.empty(0, dtype=np.int64)
        self.anchored = False
        self.safe_us = 0
        self.periods_jumped = 0

    @property
    def every(self) -> int:
        """Periods from one returned edge to the next."""
        return self._parts.every

    @every.setter
    def every(self, every: int) -> None:
        self._parts = self._parts._replace(every=every)

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return self._counts._asdict()

    def first_pair_us(self, end_us: int) -> int | None:
        """Return the first trigger that the next one, up to ``end_us``, shows to be the laser's."""
        known = self._triggers_us[: np.searchsorted(self._triggers_us, end_us, "right")]
        tolerance_us = _tolerance_us(self._parts)
        for trigger_us, next_us in pairwise(known.tolist()):
            if _agree(trigger_us, next_us, self._parts, tolerance_us):
                return int(trigger_us)
        return None

    @property
    def first_trigger_us(self) -> int | None:
        """Earliest trigger not used yet."""
        return int(self._triggers_us[0]) if self._triggers_us.size else None

    @property
    def triggered(self) -> bool:
        """Return whether triggers set the edges."""
        return self._state.triggered

    @property
    def last_us(self) -> int:
        """Time of the last edge returned or skipped."""
        return self._state.last_us

    def middle_after(self, multiple: int) -> int:
        """Return the middle of the period that begins with the next multiple of ``multiple``."""
        ahead = multiple - self._state.number % multiple
        step = self._state.step + ahead
        return self._edge_us(step) + self._parts.quotient_us // 2

    def shift(self, by_us: int) -> None:
        """Move all edges not returned yet by less than half a period."""
        self._state = self._state._replace(anchor_us=self._state.anchor_us + by_us)

    def add_triggers(self, t_us: NDArray[np.int64]) -> None:
        """Append rising edges of the trigger input, in time order."""
        self._triggers_us = np.concatenate([self._triggers_us, t_us])

    def anchor(self, edge_us: int, start_us: int, triggered: bool = False) -> None:
        """Fix the phase by an edge at ``edge_us`` and begin with the last edge until ``start_us``.

        With ``triggered`` it is the first of two triggers that agree.

        With ``every`` > 1 it is the last one whose index is a multiple of it. It is the next one
        where more than `_MISSING_SHARE` of that profile is over: in what is left of it anything
        follows the laser.
        """
        every = self._parts.every
        self._state = _State(anchor_us=edge_us, triggered=triggered)
        locks = self._counts.phase_locks + triggered
        self._counts = self._counts._replace(phase_locks=locks)
        first = (self._step_at(start_us) // every) * every
        if start_us - self._edge_us(first) > _MISSING_SHARE * every * self._period:
            first += every
        self._seek(first - 1)
        self.anchored = True

    def jump(self, t_us: int) -> None:
        """Skip profiles that end before ``t_us``, the time of the next event, if there are many."""
        target_us = t_us if self.first_trigger_us is None else min(t_us, self.first_trigger_us)
        if target_us - self.last_us <= _JUMP_PERIODS * self._period:
            return
        every, state, counts = self._parts.every, self._state, self._counts
        # The edge of the target's profile has not been returned yet.
        skipped = self._step_at(target_us) - 1 - every - state.step
        skipped -= skipped % every
        if skipped <= 0:
            return
        self.periods_jumped += skipped // every
        if state.triggered:
            self._state = state._replace(missed=state.missed + skipped)
            self._counts = counts._replace(edges_bridged=counts.edges_bridged + skipped)
        self._seek(state.step + skipped)

    def watermark_after(self, newest_us: int) -> int:
        """Return the watermark that makes everything up to ``newest_us`` certain, nothing later."""
        if not self.triggered:
            return newest_us + 1
        return newest_us + 1 + int(_tolerance_us(self._parts))

    def advance(self, watermark_us: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the edges certain now and their indices: views valid until the next call.

        Sets ``safe_us``. When ``EDGES_MAX`` edges are returned there may be more: assign the
        events, then call again.
        """
        # Plain tuples cross into compiled code faster than named ones.
        new = _Advance(
            *_schedule(
                tuple(self._state),
                tuple(self._counts),
                self._parts,
                self._triggers_us,
                watermark_us,
                self._edges_us,
                self._indices,
            )
        )
        self.safe_us = new.safe_us
        self._state, self._counts = _State._make(new.state), _Counts._make(new.counts)
        self._triggers_us = self._triggers_us[new.triggers :]
        return self._edges_us[: new.edges], self._indices[: new.edges]

    def ahead(self, until_us: int) -> EdgesAhead:
        """Return copies of what `advance` would return, and its ``safe_us``; nothing advances."""
        before = self._state, self._counts, self._triggers_us, self.safe_us
        edges_us, indices = (values.copy() for values in self.advance(until_us))
        ahead = EdgesAhead(edges_us, indices, self.safe_us)
        self._state, self._counts, self._triggers_us, self.safe_us = before
        return ahead

    def _edge_us(self, step: int) -> int:
        return self._state.anchor_us + round(step * self._period)

    def _step_at(self, t_us: int) -> int:
        """Count edges from the anchor to the last one at or before ``t_us``."""
        elapsed = t_us - self._state.anchor_us
        step = int(elapsed / self._period) + 1
        while round(step * self._period) > elapsed:
            step -= 1
        return step

    def _seek(self, step: int) -> None:
        """Make ``step`` the last edge returned."""
        numerator, denominator = self._period.as_integer_ratio()
        elapsed_us, remainder = divmod(step * numerator, denominator)
        self._state = self._state._replace(
            step=step,
            elapsed_us=elapsed_us,
            remainder=remainder,
            number=self._state.number + step - self._state.step,
            last_us=self._edge_us(step),
        )


@kernel
def _rounded(quotient, remainder, denominator):
    """Return ``quotient + remainder / denominator`` to the nearest integer, half to even."""
    twice = 2 * remainder
    if twice > denominator or (twice == denominator and quotient & 1):
        return quotient + 1
    return quotient


@entry_kernel
def _tolerance_us(period):
    """Return the largest distance of a trigger from the edge that it belongs to."""
    return max((period.quotient_us + 1) // _TOLERANCE_SHARE, 1)


@entry_kernel
def _agree(trigger_us, next_us, period, tolerance_us):
    """Return whether two triggers are one period apart, or two."""
    apart_us = next_us - trigger_us
    periods = 1 + (2 * apart_us > 3 * period.quotient_us)
    return abs(apart_us - periods * period.quotient_us) <= tolerance_us


@entry_kernel
def _schedule(state, counts, period, triggers_us, watermark_us, edges_us, indices):
    """Write the edges that are certain once everything before the watermark is known.

    Returns what an `_Advance` is made of.
    """
    anchor_us, step, at_us, remainder, index, last_us, triggered, missed, lone_us = state
    used, spurious, bridged, locks = counts
    tolerance_us = _tolerance_us(period)
    n = 0
    taken = 0
    safe_us = watermark_us
    while True:
        next_us = at_us + period.quotient_us
        next_remainder = remainder + period.remainder
        if next_remainder >= period.denominator:
            next_remainder -= period.denominator
            next_us += 1
        predicted_us = anchor_us + _rounded(next_us, next_remainder, period.denominator)
        if n == edges_us.size:
            safe_us = min(watermark_us, last_us)
            break
        locked = triggered and missed < _MISSED_MAX
        deadline_us = predicted_us + tolerance_us if triggered else predicted_us
        trigger_us = triggers_us[taken] if taken < triggers_us.size else watermark_us
        if trigger_us <= deadline_us and trigger_us < watermark_us:
            edge_us = trigger_us
            taken += 1
            if locked and edge_us < predicted_us - tolerance_us:
                spurious += 1
                continue
            if not locked:
                before_us, lone_us = lone_us, edge_us
                spurious += 1
                if not _agree(before_us, edge_us, period, tolerance_us):
                    continue
                lone_us = np.int64(_NO_TRIGGER_US)
                spurious -= 2
                used += 1
                locks += 1
            used += 1
            triggered = True
            anchor_us = edge_us
            missed = step = at_us = remainder = 0
            if not locked and edge_us - last_us < tolerance_us:
                # The edge predicted last was this one: later edges count from the trigger.
                continue
        elif deadline_us < watermark_us:
            edge_us = predicted_us
            step += 1
            at_us, remainder = next_us, next_remainder
            if triggered:
                missed += 1
                bridged += 1
        else:
            safe_us = min(watermark_us, predicted_us)
            break
        index += 1
        last_us = edge_us
        if index % period.every == 0:
            edges_us[n] = edge_us
            indices[n] = index
            n += 1
    state = anchor_us, step, at_us, remainder, index, last_us, triggered, missed, lone_us
    return n, taken, safe_us, state, (used, spurious, bridged, locks)
