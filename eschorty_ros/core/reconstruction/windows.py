"""Windows of a stream reconstructed at the same time, each by a thread of its own."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.evt3.cuts import Cut, next_cut
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.held_events import Arrays
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction import profile_rows
from eschorty_ros.core.reconstruction.profile_assembler import Edges, ProfileAssembler, Span
from eschorty_ros.core.reconstruction.profiles import LineRows, Profiles
from eschorty_ros.core.reconstruction.settings import Settings

JOBS_MAX = 256
# Windows that wait for a thread, so that no thread waits while rows are handed on.
_WAITING = 2


class _Assembled(NamedTuple):
    """Where a window ends, its rows in parts, and the number of those beyond the pole."""

    end: Cut
    rows: list[LineRows]
    beyond_pole: int


class _Window(NamedTuple):
    """A window that a thread assembles: where it begins, and what is to come of it.

    ``first`` holds the decoder's state at the beginning.
    """

    begin: Cut
    first: Decoder
    decoder: Decoder
    assembler: ProfileAssembler
    result: Future[_Assembled]


class WindowAssembler:
    """A `ProfileAssembler` that turns windows of `WINDOW_EVENTS` events into rows on all cores.

    A window begins without knowledge of the events before it, so that any thread can decode it from
    the words' place on: a pass that only counts events finds where, and with which decoder's state.
    That is compared with the state in which the window before ends. Where they differ, in a stream
    with faults, and where the sensor's edge cuts the line, the window is assembled again, after
    the one before it. So rows and counts are those of one assembler, in the same order.

    Where nothing comes between rows and ranges the threads compute the ranges, too: rows are
    `Profiles`, and the counts have ``points_beyond_pole``.

    - ``jobs``: Threads.
    - ``each``: Called with the rows of each window as soon as those before it are known.
    """

    def __init__(
        self, settings: Settings, model: RangeModel, jobs: int, each: Callable[[LineRows], None]
    ) -> None:
        self._each = each
        self._model = model
        self._ranges = "on" not in (settings.reflectance, settings.reflectance_compensation)
        self._jobs = jobs
        self._pool = ThreadPoolExecutor(jobs, "window")
        self._open = ProfileAssembler(settings, model)
        self._idle = deque(ProfileAssembler(settings, model) for _ in range(jobs + _WAITING))
        self._counts: Counter[str] = Counter()
        self._at = Cut(0, 0)

    def restart(
        self, modulation: Modulation, every: int, edge_us: int, first: Arrays | None = None
    ) -> None:
        """Drop the open period; see `ProfileAssembler.restart`."""
        self._open.restart(modulation, every, edge_us, first)

    def set_stage_speed(self, mm_s: float) -> None:
        """Set the stage's speed from now on; 0 where it is not known."""
        for assembler in (self._open, *self._idle):
            assembler.set_stage_speed(mm_s)

    @property
    def has_begun(self) -> bool:
        """Return whether a period is open."""
        return self._open.has_begun

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name."""
        counts = Counter(self._open.counters)
        counts.update(self._counts)
        return dict(counts)

    def merge(self, held: Arrays, new: Arrays, edges: Edges) -> None:
        """Assign events to periods, in this thread; see `ProfileAssembler.merge`."""
        self._open.merge(held, new, edges)

    def close(self) -> None:
        """Close the open period if it has events; it stays open for further ones."""
        self._open.close()

    def take(self) -> list[LineRows]:
        """Return the rows of the periods closed since the last pass over words."""
        return self._counted(self._rows(self._open, self._at))

    def merge_words(
        self, words: NDArray[np.uint16], decoder: Decoder, span: Span, edges: Edges
    ) -> Cut:
        """Decode words into periods, as `ProfileAssembler.merge_words` does."""
        if words.size < self._open.events_left // 2:
            return self._open.merge_words(words, decoder, span, edges)
        self._words, self._span, self._edges = words, span._replace(one_window=True), edges
        self._decoder, self._first_decoder = decoder, decoder
        self._at, going = Cut(0, 0), True
        if self._open.is_learning:
            going = self._go_on()
        probe, cut, left = decoder.copied(), self._at, self._open.events_left
        running = deque([self._start(cut, decoder, decoder, self._open)] if going else [])
        while going:
            found = next_cut(words, cut, edges.t_us, left, span.through, probe)
            if found is None:
                break
            cut, left = found, profile_rows.WINDOW_EVENTS
            if len(running) >= self._jobs + _WAITING:
                going = self._accept(running.popleft(), going)
                if not going:
                    break
            assembler = self._idle.popleft()
            assembler.begin_window(edges, cut.edge - 1, self._open)
            running.append(self._start(cut, probe.copied(), probe.copied(), assembler))
        while running:
            going = self._accept(running.popleft(), going)
        while going:
            going = self._go_on()
        if self._decoder is not decoder:
            decoder.add_counts(self._decoder)
            decoder.go_on_from(self._decoder)
        # The words may be those of a file that is to be closed.
        self._words = words[:0].copy()
        return self._at

    def _start(
        self, begin: Cut, first: Decoder, decoder: Decoder, assembler: ProfileAssembler
    ) -> _Window:
        result = self._pool.submit(self._assemble, begin, decoder, assembler)
        return _Window(begin, first, decoder, assembler, result)

    def _assemble(self, begin: Cut, decoder: Decoder, assembler: ProfileAssembler) -> _Assembled:
        """Assemble a window from ``begin`` on."""
        words, later = self._words[begin.word :], self._edges.part(begin.edge)
        read, used = assembler.merge_words(words, decoder, self._span, later)
        return self._rows(assembler, Cut(int(begin.word + read), begin.edge + used))

    def _rows(self, assembler: ProfileAssembler, end: Cut) -> _Assembled:
        rows = assembler.take()
        if not self._ranges:
            return _Assembled(end, rows, 0)
        profiles: list[LineRows] = [Profiles.from_rows(part, self._model) for part in rows]
        return _Assembled(end, profiles, sum(map(len, rows)) - sum(map(len, profiles)))

    def _counted(self, done: _Assembled) -> list[LineRows]:
        self._at = done.end
        self._counts["points_beyond_pole"] += done.beyond_pole
        return done.rows

    def _hand_on(self, done: _Assembled) -> None:
        """Hand on the rows that follow those before."""
        for rows in self._counted(done):
            self._each(rows)

    def _go_on(self) -> bool:
        """Assemble the window after the last one in this thread; return whether it is over."""
        self._hand_on(self._assemble(self._at, self._decoder, self._open))
        return self._open.window_is_over

    def _accept(self, window: _Window, going: bool) -> bool:
        """Wait for a window and append it to those before it; return whether it is over.

        Without ``going`` it is dropped.
        """
        result, assembler = window.result.result(), window.assembler
        if assembler is self._open:
            self._hand_on(result)
            return assembler.window_is_over
        at_end = window.begin == self._at and self._decoder.is_at(window.first)
        if not going or self._open.is_cut or not at_end:
            self._idle.append(assembler)
            return going and self._go_on()
        self._counts.update(self._open.counters)
        if self._decoder is not self._first_decoder:
            self._first_decoder.add_counts(self._decoder)
        self._idle.append(self._open)
        self._open, self._decoder = assembler, window.decoder
        self._hand_on(result)
        return assembler.window_is_over
