"""Windows of a stream assembled at the same time, each by a thread of its own."""

from __future__ import annotations

from collections import Counter, deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.held_events import EventArrays, HeldEvents
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction import profile_assembler
from eschorty_ros.core.reconstruction.profile_assembler import Edges, ProfileAssembler
from eschorty_ros.core.reconstruction.profiles import LineRows
from eschorty_ros.core.reconstruction.settings import Settings

JOBS_MAX = 256

_NO_EVENTS = np.empty(0, "i8"), np.empty(0, "u2"), np.empty(0, "u2"), np.empty(0, "u1")
_NO_EDGES = Edges(np.empty(0, np.int64), np.empty(0, np.int64))


class _Window(NamedTuple):
    """The events of a window, and the edges from its first to the one that ends it.

    ``every`` is the number of periods in a profile; ``last`` closes the open period.
    """

    events: HeldEvents
    edges: list[Edges]
    modulation: Modulation
    every: int
    last: bool = False


class _Assembled(NamedTuple):
    """A window with its rows and counts, and whether a footprint was learned in it."""

    window: _Window
    rows: LineRows
    counts: Counter[str]
    learned: bool


class WindowAssembler:
    """A `ProfileAssembler` that gives each window of `WINDOW_EVENTS` events to another thread.

    Kernels release the interpreter's lock. The rows and counts are those of one assembler, in the
    same order; as many windows as threads and one more are in memory. ``close`` ends the stream.
    A window with lines that the sensor's edge cuts needs the footprint learned before it: it is
    assembled again, after the windows before it.

    Parameters
    ----------
    settings : Settings
        Not with ``centroid`` learned, which follows the whole stream.
    model : RangeModel
    jobs : int
        Threads.
    """

    def __init__(self, settings: Settings, model: RangeModel, jobs: int) -> None:
        self._jobs = jobs
        self._pool = ThreadPoolExecutor(jobs, "window")
        self._idle = deque(ProfileAssembler(settings, model) for _ in range(jobs))
        self._serial = ProfileAssembler(settings, model)
        # Room for the profile in which the window becomes full, too.
        capacity = profile_assembler.WINDOW_EVENTS * 5 // 4
        self._buffers = deque(HeldEvents(capacity) for _ in range(jobs + 2))
        self._running: deque[Future[_Assembled]] = deque()
        self._done: list[LineRows] = []
        self._counts = Counter(self._serial.counters)

    def restart(self, modulation: Modulation, every: int) -> None:
        """Drop the open window; further events belong to profiles of ``every`` periods."""
        self._window = _Window(self._buffers.popleft(), [], modulation, every)
        # Events of the open window before its first edge.
        self._outside = 0

    has_begun = False

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name, complete after ``close``."""
        return dict(self._counts)

    def merge(self, held: EventArrays, new: EventArrays, edges: Edges) -> None:
        """Add events and edges to the open window, and begin others where it is full.

        Parameters
        ----------
        held, new : tuple of ndarray
            Times in us, columns, rows and polarities in time order, first those of ``held``.
        edges : Edges
            No more events come before the last one.
        """
        size = held[0].size + new[0].size
        before = np.searchsorted(held[0], edges.t_us) + np.searchsorted(new[0], edges.t_us)
        event = edge = 0
        while edge < before.size:
            ahead = len(self._window.events) - event + before[edge:]
            if not self._window.edges:
                self._outside = int(ahead[0])
            full = ahead - self._outside >= profile_assembler.WINDOW_EVENTS
            if not full.any():
                break
            last = edge + int(np.argmax(full))
            self._append(held, new, event, int(before[last]))
            self._window.edges.append(_part(edges, edge, last + 1))
            self._submit()
            self._window.edges.append(_part(edges, last, last + 1))
            event, edge = int(before[last]), last + 1
        self._append(held, new, event, size)
        if edge < before.size:
            self._window.edges.append(_part(edges, edge, before.size))

    def close(self) -> None:
        """Close the open period if it has events, and wait for all windows."""
        self._submit(last=True)
        while self._running:
            self._collect()
        self._pool.shutdown()

    def take(self) -> LineRows:
        """Return the rows of the windows done since the last call, in order."""
        while self._running and self._running[0].done():
            self._collect()
        done, self._done = self._done, []
        return LineRows.concatenate(done)

    def _append(self, held: EventArrays, new: EventArrays, begin: int, end: int) -> None:
        first = held[0].size
        for events, offset in ((held, 0), (new, first)):
            a, b = max(begin - offset, 0), max(end - offset, 0)
            if a < min(b, events[0].size):
                t, x, y, p = events
                self._window.events.append((t[a:b], x[a:b], y[a:b], p[a:b]))

    def _submit(self, last: bool = False) -> None:
        while len(self._running) > self._jobs:
            self._collect()
        window = self._window._replace(last=last)
        self._running.append(self._pool.submit(self._assemble_apart, window))
        self._window = window._replace(events=self._buffers.popleft(), edges=[])
        self._outside = 0

    def _collect(self) -> None:
        """Wait for the first window that runs; keep its rows and counts."""
        done = self._running.popleft().result()
        if done.learned or self._serial.learns:
            done = _assembled(self._serial, done.window)
        self._done.append(done.rows)
        self._counts.update(done.counts)
        events = done.window.events
        events.drop(len(events))
        self._buffers.append(events)

    def _assemble_apart(self, window: _Window) -> _Assembled:
        assembler = self._idle.popleft()
        assembler.forget()
        done = _assembled(assembler, window)
        self._idle.append(assembler)
        return done


def _assembled(assembler: ProfileAssembler, window: _Window) -> _Assembled:
    before = Counter(assembler.counters)
    assembler.restart(window.modulation, window.every)
    t_us, period = (np.concatenate(values) for values in zip(_NO_EDGES, *window.edges, strict=True))
    assembler.merge(_NO_EVENTS, window.events.arrays, Edges(t_us, period))
    if window.last:
        assembler.close()
    counts = Counter(assembler.counters)
    counts.subtract(before)
    return _Assembled(window, assembler.take(), counts, assembler.has_learned)


def _part(edges: Edges, begin: int, end: int) -> Edges:
    """Return a copy of some edges."""
    return Edges(edges.t_us[begin:end].copy(), edges.period[begin:end].copy())
