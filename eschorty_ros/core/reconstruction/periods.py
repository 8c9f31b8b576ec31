"""Cutting the stream of events into modulation periods."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.evt3 import Events
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.edges import EDGES_MAX
from eschorty_ros.core.modulation.held_events import EventArrays, HeldEvents
from eschorty_ros.core.modulation.phase_lock import END_OF_STREAM_US, PhaseLock
from eschorty_ros.core.reconstruction.profile_assembler import Edges, ProfileAssembler
from eschorty_ros.core.reconstruction.profile_length import ProfileLength
from eschorty_ros.core.reconstruction.windows import WindowAssembler


class PeriodCutter:
    """Assigns events to the periods of one modulation; holds back those not certain yet.

    Parameters
    ----------
    modulation : Modulation
    every : int
        Periods per profile; 0 chooses them from the first events.
    assembler : ProfileAssembler or WindowAssembler
        Takes the events and the periods' beginnings.

    Attributes
    ----------
    lock : PhaseLock
    """

    def __init__(
        self,
        modulation: Modulation,
        every: int,
        assembler: ProfileAssembler | WindowAssembler,
    ) -> None:
        self.lock = PhaseLock(modulation, every)
        self._modulation = modulation
        self._length = ProfileLength(modulation)
        self._held = HeldEvents()
        self._assembler = assembler

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return {
            "events_held": len(self._held),
            "events_outside_phase": self.lock.refused,
            "periods_empty": self.lock.schedule.periods_jumped,
            **self.lock.counters,
        }

    def add(self, events: Events, watermark_us: int) -> None:
        """Assign ``events``; none before ``watermark_us`` is still to come."""
        arrays = events.t, events.x, events.y, events.p
        if self.lock.schedule.anchored:
            self._assign(arrays, watermark_us)
            return
        self._held.append(arrays)
        if self._begin(watermark_us):
            self._assign_held(watermark_us)

    def finish(self, newest_us: int | None) -> None:
        """Assign the events held back, up to ``newest_us``, and close the open period."""
        lock = self.lock
        if not lock.schedule.anchored and not self._begin(END_OF_STREAM_US, last=True):
            return
        if newest_us is not None:
            self._assign_held(lock.schedule.watermark_after(newest_us))
        self._assembler.close()

    def _begin(self, watermark_us: int, last: bool = False) -> bool:
        """Begin with the first period as soon as the held events allow it; return whether."""
        schedule = self.lock.schedule
        if schedule.every == 0 and len(self._held):
            schedule.every = self._length.choose(self._held, watermark_us, last)
        if schedule.every == 0 or not self.lock.find(self._held, watermark_us, last):
            return False
        self._assembler.restart(self._modulation, schedule.every)
        return True

    def _assign_held(self, watermark_us: int) -> None:
        t, x, y, p = self._held.arrays
        self._assign((t[:0], x[:0], y[:0], p[:0]), watermark_us)

    def _assign(self, new: EventArrays, watermark_us: int) -> None:
        """Assign the events certain before the watermark, held ones first; hold back the rest."""
        held, lock = self._held, self.lock
        first = 0
        more = True
        while more:
            pending_us = held.arrays[0] if len(held) else new[0][first:]
            if pending_us.size:
                lock.skip_to(int(pending_us[0]))
            edges_us, indices = lock.schedule.advance(lock.limit(watermark_us))
            safe_us = lock.schedule.safe_us
            ready = int(np.searchsorted(held.arrays[0], safe_us))
            end = first
            if ready == len(held):
                end = max(int(np.searchsorted(new[0], safe_us)), first)
            if ready or end > first or len(edges_us):
                before, after = _part(held.arrays, 0, ready), _part(new, first, end)
                for t, _, _, p in (before, after):
                    lock.observe(t, p)
                self._assembler.merge(before, after, Edges(edges_us, indices))
                held.drop(ready)
                first = end
            more = len(edges_us) == EDGES_MAX or lock.close_block(watermark_us)
        t, x, y, p = new
        held.append((t[first:], x[first:], y[first:], p[first:]))


def _part(events: EventArrays, begin: int, end: int) -> EventArrays:
    t, x, y, p = events
    return t[begin:end], x[begin:end], y[begin:end], p[begin:end]
