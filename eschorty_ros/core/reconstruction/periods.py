"""Cutting the stream of events into modulation periods."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Decoder, Events
from eschorty_ros.core.evt3.words import EXT_TRIGGER
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.edges import EDGES_MAX
from eschorty_ros.core.modulation.held_events import NO_EVENTS, Arrays, HeldEvents
from eschorty_ros.core.modulation.phase_lock import END_OF_STREAM_US, PhaseLock
from eschorty_ros.core.reconstruction.edge_recorder import EdgeRecorder
from eschorty_ros.core.reconstruction.profile_assembler import Edges, ProfileAssembler, Span
from eschorty_ros.core.reconstruction.profile_length import ProfileLength
from eschorty_ros.core.reconstruction.windows import WindowAssembler

PASS_WORDS = 1 << 19
"""Words that one thread decodes in a pass."""
# Edges are computed this far ahead of the newest event.
_AHEAD_US = 100_000


class PeriodCutter:
    """Assigns events to the periods of one modulation; holds back those not certain yet.

    - ``every``: Periods per profile; 0 chooses them from the first events.
    - ``assembler``: Takes the events and the periods' beginnings.

    Public attribute ``recorder``: Takes them instead while it is set.
    """

    def __init__(
        self, modulation: Modulation, every: int, assembler: ProfileAssembler | WindowAssembler
    ) -> None:
        self.lock = PhaseLock(modulation, every)
        self._modulation = modulation
        self._length = ProfileLength(modulation)
        self._held = HeldEvents()
        self._assembler = assembler
        self.recorder: EdgeRecorder | None = None

    @property
    def fills_columns(self) -> bool:
        """Return whether light that follows the laser comes from many rows of a column."""
        return self._length.fills_columns

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        return {
            "events_held": len(self._held),
            "events_outside_phase": self._held.refused,
            "periods_empty": self.lock.schedule.periods_jumped,
            **self.lock.counters,
        }

    @property
    def _sink(self) -> ProfileAssembler | WindowAssembler | EdgeRecorder:
        return self._assembler if self.recorder is None else self.recorder

    def add(self, events: Events, watermark_us: int) -> None:
        """Assign ``events``; none before ``watermark_us`` is still to come."""
        arrays = events.t, events.x, events.y, events.p
        if self.lock.schedule.anchored:
            self._assign(arrays, watermark_us)
            return
        self._held.append(arrays)
        if self._begin(watermark_us):
            self._assign(NO_EVENTS, watermark_us)

    @property
    def triggered(self) -> bool:
        """Return whether triggers set the edges, and a period is open."""
        return self.lock.schedule.triggered and self._sink.has_begun

    def _knows_ahead(self) -> bool:
        """Return whether the next edges are known before their events, and a period is open.

        They are not where triggers set them, and where the phase is tracked the first events of a
        block have to be seen.
        """
        schedule = self.lock.schedule
        return (
            schedule.anchored
            and not schedule.triggered
            and schedule.first_trigger_us is None
            and not self.lock.observes
            and self._sink.has_begun
        )

    def add_words(self, words: NDArray[np.uint16], decoder: Decoder, floor_us: int) -> int:
        """Decode ``words`` and assign their events without storing them; return the words read.

        Fewer than all are read before a trigger and where the next edges are not known. Events
        before ``floor_us`` count as at that time.
        """
        sink, lock, schedule = self._sink, self.lock, self.lock.schedule
        now_us, read, stopped = floor_us, 0, True
        while stopped and self._knows_ahead():
            ahead_us = _AHEAD_US if words.size <= PASS_WORDS else END_OF_STREAM_US // 2
            edges_us, indices, end_us = schedule.ahead(lock.limit(now_us + ahead_us))
            span, edges = Span(floor_us, end_us), Edges(edges_us, indices)
            held, used = self._held.arrays, 0
            if len(self._held):
                if held[0][-1] >= end_us:
                    break
                used = int(np.searchsorted(edges_us, held[0][-1], "right"))
                sink.merge(held, NO_EVENTS, edges.part(0, used))
                edges = edges.part(used)
                self._held.drop(len(self._held))
            count, more = sink.merge_words(words[read:], decoder, span, edges)
            read, used = read + int(count), used + more
            stopped = read < words.size and int(words[read]) >> 12 != EXT_TRIGGER
            now_us = max(decoder.settled_us or 0, decoder.newest_us + 1)
            if stopped:
                now_us = max(now_us, (decoder.time_us or 0) + 1)
            edges_us, indices = schedule.advance(lock.limit(now_us))
            if len(edges_us) > used:
                sink.merge(NO_EVENTS, NO_EVENTS, Edges(edges_us, indices).part(used))
            if not lock.close_block(now_us) and stopped:
                lock.skip_to(now_us - 1)
        return read

    def add_triggered(
        self, words: NDArray[np.uint16], decoder: Decoder, floor_us: int, watermark_us: int
    ) -> int:
        """Decode ``words`` as `add_words` does where triggers set the edges.

        All triggers before ``watermark_us`` are known.
        """
        sink, lock, schedule = self._sink, self.lock, self.lock.schedule
        read, more = 0, True
        while more:
            values = schedule.advance(lock.limit(watermark_us))
            edges, held = Edges(*(each.copy() for each in values)), self._held.arrays
            more = edges.t_us.size == EDGES_MAX
            ready = int(np.searchsorted(held[0], schedule.safe_us))
            if ready < len(self._held):
                sink.merge(_part(held, 0, ready), NO_EVENTS, edges)
                self._held.drop(ready)
                continue
            used = int(np.searchsorted(edges.t_us, held[0][-1], "right")) if ready else 0
            sink.merge(held, NO_EVENTS, edges.part(0, used))
            self._held.drop(ready)
            span = Span(floor_us, schedule.safe_us, through=True)
            count, later = sink.merge_words(words[read:], decoder, span, edges.part(used))
            sink.merge(NO_EVENTS, NO_EVENTS, edges.part(used + later))
            read += int(count)
        return read

    def finish(self, newest_us: int | None) -> None:
        """Assign the events held back, up to ``newest_us``, and close the open period."""
        lock = self.lock
        if not lock.schedule.anchored and not self._begin(END_OF_STREAM_US, last=True):
            return
        if newest_us is not None:
            self._assign(NO_EVENTS, lock.schedule.watermark_after(newest_us))
        self._assembler.close()

    def _begin(self, watermark_us: int, last: bool = False) -> bool:
        """Begin with the first period as soon as the held events allow it; return whether."""
        schedule = self.lock.schedule
        if schedule.every == 0 and len(self._held):
            schedule.every = self._length.choose(self._held, watermark_us, last)
        if schedule.every == 0 or not self.lock.find(self._held, watermark_us, last):
            return False
        window = self.lock.window or self._length.window
        first = None if window is None else _part(self._held.arrays, *window)
        self._assembler.restart(self._modulation, schedule.every, schedule.last_us, first)
        return True

    def _assign(self, new: Arrays, watermark_us: int) -> None:
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
                self._sink.merge(before, after, Edges(edges_us, indices))
                held.drop(ready)
                first = end
            more = len(edges_us) == EDGES_MAX or lock.close_block(watermark_us)
        t, x, y, p = new
        held.append((t[first:], x[first:], y[first:], p[first:]))


def _part(events: Arrays, begin: int, end: int) -> Arrays:
    t, x, y, p = events
    return t[begin:end], x[begin:end], y[begin:end], p[begin:end]
