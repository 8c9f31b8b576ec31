"""Phase of the modulation where nobody tells it: found in the events, then followed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import TIME_LIMIT, exact, whole
from eschorty_ros.core.modulation.held_events import HeldEvents
from eschorty_ros.core.modulation.modulation import Modulation
from eschorty_ros.core.modulation.phase import EdgeSchedule
from eschorty_ros.core.modulation.phase_estimate import PhaseEstimate, decide_window, estimate_phase

FLUSH_US = 1 << 61
_HELD_EVENTS_MAX = 1 << 22
# The phase is looked at in blocks this long; 100 ppm are then at most 0.2 % of a period up to
# 1 kHz, and 3 % at 20 kHz.
_BLOCK_PERIODS = 8
_BLOCK_US = 16_000
_EVENTS_MIN = 128
_EVENTS_MAX = 4096
_GAIN = 0.5
# Shares of the period: more is no drift but a generator that began anew, if seen twice alike.
_DRIFT_MAX = 0.125
_ALIKE = 0.0625


class PhaseLock:
    """Anchors an ``EdgeSchedule`` and, when the phase was estimated, keeps it on the events.

    A generator and a sensor with clocks of their own drift apart: 100 ppm are a period of 1 kHz
    after 10 s. So the phase is estimated again for every block of periods, from the block's first
    events, and the edges after the block are moved by half of what they are off. A phase that is
    off by more than an eighth of a period in two blocks running is taken as it is: the laser was
    switched off and on. Blocks are counted in periods and decided before any later event is
    assigned, so the result does not depend on how the stream is cut.

    Nothing is followed where ``on_edge_us`` is given or triggers come.

    Parameters
    ----------
    modulation : Modulation
    every : int
        See ``EdgeSchedule``.

    Attributes
    ----------
    schedule : EdgeSchedule
    estimate : PhaseEstimate or None
        The first one.
    missing : bool
        Whether the stream ended without a phase; periods count from the first event then.
    refused : int
        Events dropped because they waited too long for a phase.
    corrections, relocks : int
        Blocks after which the edges were moved a little, and to another phase.
    """

    def __init__(self, modulation: Modulation, every: int = 1) -> None:
        self.schedule = EdgeSchedule(modulation, every)
        self.estimate: PhaseEstimate | None = None
        self.missing = False
        self.refused = 0
        self.corrections = 0
        self.relocks = 0
        self._modulation = modulation
        period_us = modulation.period_us
        self._block = max(_BLOCK_PERIODS, round(_BLOCK_US / period_us))
        self._end_us: int | None = None
        self._off: float | None = None
        self._count = 0
        self._t = np.empty(_EVENTS_MAX, np.int64)
        self._p = np.empty(_EVENTS_MAX, np.uint8)

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return self.schedule.counters | {
            "phase_corrections": self.corrections,
            "phase_relocks": self.relocks,
        }

    def find(self, held: HeldEvents, now_us: int, last: bool = False) -> bool:
        """Anchor the schedule as soon as the held events allow; drops windows beyond the limit.

        ``last``: no more events come. Whether it is anchored.
        """
        whole("now_us", now_us, -TIME_LIMIT, TIME_LIMIT)
        if len(held) == 0:
            return False
        first_us = int(held.t[0])
        if self._modulation.on_edge_us is not None:
            self.schedule.anchor(self._modulation.on_edge_us, first_us)
            return True
        begin = held.refused
        while True:
            decided = decide_window(held.t[begin:], now_us, self._modulation)
            size, end_us = decided or (0, FLUSH_US)
            trigger = self.schedule.first_trigger_us
            if trigger is not None and trigger <= end_us:
                self.schedule.anchor(trigger, min(first_us, trigger))
                return True
            if decided is None:
                break
            window = slice(begin, begin + size)
            estimate = estimate_phase(held.t[window], held.p[window], self._modulation)
            if estimate.found:
                return self._anchor(estimate, first_us)
            begin += size
            held.refused = begin
            if begin > _HELD_EVENTS_MAX:
                self.refused += begin
                held.drop(begin)
                begin = 0
                if len(held) == 0:
                    return False
                first_us = int(held.t[0])
        if last:
            estimate = estimate_phase(held.t, held.p, self._modulation)
            if estimate.found:
                return self._anchor(estimate, first_us)
            self.missing = True
            self.schedule.anchor(first_us, first_us)
        return last

    def _anchor(self, estimate: PhaseEstimate, first_us: int) -> bool:
        self.estimate = estimate
        self.schedule.anchor(estimate.edge_us, first_us)
        self._end_us = self.schedule.middle_after(self._block)
        return True

    def skip_to(self, t_us: int) -> None:
        """Tell that the next event to be assigned is at ``t_us``; see ``EdgeSchedule.jump``."""
        whole("t_us", t_us, -TIME_LIMIT, TIME_LIMIT)
        if self._end_us is None or t_us < self._end_us:
            self.schedule.jump(t_us)
        elif self._count == 0:
            # Blocks without events change nothing.
            self.schedule.jump(t_us)
            self._end_us = self.schedule.middle_after(self._block)

    def limit(self, watermark_us: int) -> int:
        """Watermark up to which the schedule is settled."""
        whole("watermark_us", watermark_us, -TIME_LIMIT, TIME_LIMIT)
        if self._end_us is not None and self.schedule.triggered:
            self._end_us = None
        return watermark_us if self._end_us is None else min(watermark_us, self._end_us)

    def observe(self, t_us: NDArray[np.int64], polarity: NDArray[np.uint8]) -> None:
        """Take note of events that were assigned, in time order."""
        t_us = exact("t_us", t_us, np.int64)
        polarity = exact("polarity", polarity, np.uint8, t_us.size)
        size = min(t_us.size, _EVENTS_MAX - self._count)
        if self._end_us is None or size <= 0:
            return
        new = slice(self._count, self._count + size)
        self._t[new], self._p[new] = t_us[:size], polarity[:size]
        self._count += size

    def settle(self, watermark_us: int) -> bool:
        """Close the block that ends before ``watermark_us``; whether there was one.

        All its events must have been observed and all its edges handed out.
        """
        whole("watermark_us", watermark_us, -TIME_LIMIT, TIME_LIMIT)
        if self._end_us is None or watermark_us <= self._end_us:
            return False
        triggered = self.schedule.triggered
        # Edges that triggers set are not to be moved, in the block of the first one neither.
        if self._count >= _EVENTS_MIN and not triggered:
            window = slice(0, self._count)
            found = estimate_phase(self._t[window], self._p[window], self._modulation)
            if found.found:
                self._correct(found.edge_us)
        self._count = 0
        self._end_us = None if triggered else self.schedule.middle_after(self._block)
        return True

    def _correct(self, edge_us: int) -> None:
        period_us = self._modulation.period_us
        off = (edge_us - self.schedule.last_us) / period_us
        off -= round(off)
        if abs(off) <= _DRIFT_MAX:
            self._off = None
            self.schedule.shift(round(_GAIN * off * period_us))
            self.corrections += 1
            return
        before, self._off = self._off, off
        if before is not None and abs(off - before - round(off - before)) < _ALIKE:
            self._off = None
            self.schedule.shift(round(off * period_us))
            self.relocks += 1
