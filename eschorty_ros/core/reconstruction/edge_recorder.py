"""The edges in a piece of the stream, found before its events are assembled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.evt3.cuts import Cut, pass_over
from eschorty_ros.core.modulation.held_events import NO_EVENTS, Arrays
from eschorty_ros.core.modulation.phase_lock import END_OF_STREAM_US
from eschorty_ros.core.reconstruction.profile_assembler import Edges, ProfileAssembler, Span
from eschorty_ros.core.reconstruction.windows import WindowAssembler

Merge = tuple[Arrays, Arrays, Edges]


class EdgeRecorder:
    """Stands in for an assembler where edges depend on events, and keeps the edges.

    The events of words are passed over, those of arrays kept until `mark`.

    Public attributes:
    - ``has_begun``: True, as it goes on in an open period.
    - ``marked``: Words read at the last mark.
    """

    has_begun = True

    def __init__(self) -> None:
        self.marked = 0
        self._edges: list[Edges] = []
        self._merges: list[Merge] = []

    def merge(self, held: Arrays, new: Arrays, edges: Edges) -> None:
        """Keep events and edges; see `ProfileAssembler.merge`."""
        self._merges.append((_copied(held), _copied(new), Edges(*_copied(edges))))

    def merge_words(
        self, words: NDArray[np.uint16], decoder: Decoder, span: Span, edges: Edges
    ) -> Cut:
        """Decode words up to the end of ``span`` or a trigger; see `ProfileAssembler.merge_words`.

        No edge is used: `merge` brings them, too.
        """
        return Cut(pass_over(words, span.end_us, decoder), 0)

    def mark(self, read: int) -> None:
        """Drop the events: those of the words read so far can be assembled with the edges."""
        self.marked = read
        self._edges += [edges for _, _, edges in self._merges]
        self._merges.clear()

    def assemble(
        self,
        words: NDArray[np.uint16],
        decoder: Decoder,
        floor_us: int,
        assembler: ProfileAssembler | WindowAssembler,
    ) -> None:
        """Assemble the words up to the last mark, then the events and edges kept since.

        - ``words``: Those that the recorder has read.
        - ``decoder``: In the state before them.
        - ``floor_us``: Earlier events count as at that time.
        """
        parts = zip(NO_EVENTS[:1] * 2, *self._edges, strict=True)
        edges = Edges(*map(np.concatenate, parts))
        span = Span(floor_us, END_OF_STREAM_US, through=True)
        words = words[: self.marked]
        _, used = assembler.merge_words(words, decoder, span, edges)
        assembler.merge(NO_EVENTS, NO_EVENTS, edges.part(used))
        for merge in self._merges:
            assembler.merge(*merge)


def _copied(arrays: Arrays) -> Arrays:
    """Return copies: the arrays are views of buffers that are used again."""
    return tuple(array.copy() for array in arrays)
