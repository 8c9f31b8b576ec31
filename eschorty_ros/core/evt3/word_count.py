"""Counting what is in an EVT3 stream without decoding it, for rates and loss reports."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.arrays import octets
from eschorty_ros.core.evt3 import _word_count as kernels


class WordCounter:
    """Adds up events and the sensor's loss reports of one stream, at a few ns per word.

    It takes words for what they say; what a decoder would refuse (no row, outside the sensor) is
    counted too.

    Attributes
    ----------
    off, on : int
        Events by polarity.
    triggers : int
        Edges at the trigger input.
    drop_words : int
        Reports of the sensor that it dropped time words or events.
    erc_events_in, erc_events_out : int
        Events before and after the event-rate control, by its own reports.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(kernels.SIZE, np.int64)

    off = property(lambda self: int(self._counts[kernels.OFF]))
    on = property(lambda self: int(self._counts[kernels.ON]))
    triggers = property(lambda self: int(self._counts[kernels.TRIGGERS]))
    drop_words = property(lambda self: int(self._counts[kernels.DROP_WORDS]))
    erc_events_in = property(lambda self: int(self._counts[kernels.ERC_IN]))
    erc_events_out = property(lambda self: int(self._counts[kernels.ERC_OUT]))

    def add(self, data: bytes | bytearray | memoryview) -> None:
        """Count whole 16-bit words; a lone last byte is left out.

        Raises
        ------
        ArgumentError
            For anything but bytes.
        """
        view = octets("data", data)
        kernels.count_words(np.frombuffer(view[: len(view) & ~1], "<u2"), self._counts)
