"""Count what is in an EVT3 stream without decoding it, for rates and loss reports."""

from __future__ import annotations

import numpy as np
from numba import int64, typeof, types, uint16

from eschorty_ros.core.base.arrays import byte_view
from eschorty_ros.core.base.kernel import entry_kernel, kernel, record
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3._bits import popcount64

_COUNTS = (
    "off",
    "on",
    "triggers",
    "drop_words",
    "erc_events_in",
    "erc_events_out",
    "polarity",  # of vectors
    "others_type",  # whose payload is being added, 0 for none
    "payload_bits",  # of it that have come
)


class WordCounter:
    """Adds up events and the sensor's loss reports of one stream, at a few ns per word.

    It does not check the words: events that a decoder drops (no row, outside the sensor) are
    counted too.

    Public attributes:
    - ``off``, ``on``: Events by polarity.
    - ``triggers``: Edges at the trigger input.
    - ``drop_words``: Reports of the sensor that it dropped time words or events.
    - ``erc_events_in``, ``erc_events_out``: Events before and after the event-rate control, by its
      own reports.
    """

    def __init__(self) -> None:
        self._counts = record(*_COUNTS)

    off = property(lambda self: int(self._counts["off"]))
    on = property(lambda self: int(self._counts["on"]))
    triggers = property(lambda self: int(self._counts["triggers"]))
    drop_words = property(lambda self: int(self._counts["drop_words"]))
    erc_events_in = property(lambda self: int(self._counts["erc_events_in"]))
    erc_events_out = property(lambda self: int(self._counts["erc_events_out"]))

    def add(self, data: bytes | bytearray | memoryview) -> None:
        """Count complete 16-bit words; a single last byte is left out.

        Raises ``ArgumentError`` for anything but bytes.
        """
        view = byte_view("data", data)
        _count(np.frombuffer(view[: len(view) & ~1], "<u2"), self._counts)


@kernel
def _add_events(c, polarity, events):
    if polarity:
        c.on += int64(events)
    else:
        c.off += int64(events)


@kernel
def _add_payload(c, events):
    if c.others_type == w3.ERC_EVENTS_IN:
        c.erc_events_in += int64(events)
    else:
        c.erc_events_out += int64(events)


@entry_kernel(types.void(types.Array(uint16, 1, "C", readonly=True), typeof(record(*_COUNTS))))
def _count(words, c):
    """Add up events by polarity, triggers and the sensor's own loss reports."""
    for word in words:
        kind = word >> 12
        if kind == w3.VECT_12:
            _add_events(c, c.polarity, popcount64(word & 0xFFF))
        elif kind == w3.VECT_8:
            _add_events(c, c.polarity, popcount64(word & 0xFF))
        elif kind == w3.ADDR_X:
            _add_events(c, word >> 11 & 1, 1)
        elif kind == w3.VECT_BASE_X:
            c.polarity = int64(word >> 11 & 1)
        elif kind == w3.EXT_TRIGGER:
            c.triggers += 1
        elif kind == w3.OTHERS:
            subtype = word & 0xFFF
            if (
                subtype == w3.DROPPED_TIME_LOW
                or subtype == w3.DROPPED_TIME_HIGH
                or subtype == w3.DROPPED_EVENTS
            ):
                c.drop_words += 1
            counts = subtype == w3.ERC_EVENTS_IN or subtype == w3.ERC_EVENTS_OUT
            c.others_type = subtype if counts else 0
            c.payload_bits = 0
        elif kind == w3.CONTINUED_12 and c.others_type > 0 and c.payload_bits < 24:
            _add_payload(c, int64(word & 0xFFF) << c.payload_bits)
            c.payload_bits += 12
        elif kind == w3.CONTINUED_4 and c.others_type > 0 and c.payload_bits == 24:
            _add_payload(c, int64(word & 0xF) << 24)
            c.others_type = 0
        elif kind == w3.CONTINUED_12 or kind == w3.CONTINUED_4:
            c.others_type = 0
