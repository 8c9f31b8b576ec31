"""Compiled counting of EVT3 words; see ``evt3_count``."""

from __future__ import annotations

from numba import int64, types, uint16

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.evt3._bits import popcount64

# The last three are state: polarity of vectors, which count a payload belongs to (0 for none), and
# the bits of it that have come.
OFF, ON, TRIGGERS, DROP_WORDS, ERC_IN, ERC_OUT, POLARITY, PAYLOAD_OF, PAYLOAD_BITS = range(9)
SIZE = 9

_U2 = types.Array(uint16, 1, "C", readonly=True)


@kernel(types.void(_U2, int64[::1]))
def count_words(words, counts):
    """Add up events by polarity, triggers and the sensor's own loss reports."""
    polarity = counts[POLARITY]
    for word in words:
        kind = word >> 12
        if kind == w3.VECT_12:
            counts[polarity] += int64(popcount64(word & 0xFFF))
        elif kind == w3.VECT_8:
            counts[polarity] += int64(popcount64(word & 0xFF))
        elif kind == w3.ADDR_X:
            counts[word >> 11 & 1] += 1
        elif kind == w3.VECT_BASE_X:
            polarity = int64(word >> 11 & 1)
        elif kind == w3.EXT_TRIGGER:
            counts[TRIGGERS] += 1
        elif kind == w3.OTHERS:
            subtype = word & 0xFFF
            if (
                subtype == w3.DROPPED_TIME_LOW
                or subtype == w3.DROPPED_TIME_HIGH
                or subtype == w3.DROPPED_EVENTS
            ):
                counts[DROP_WORDS] += 1
            counts[PAYLOAD_BITS] = 0
            counts[PAYLOAD_OF] = 0
            if subtype == w3.ERC_EVENTS_IN:
                counts[PAYLOAD_OF] = ERC_IN
            elif subtype == w3.ERC_EVENTS_OUT:
                counts[PAYLOAD_OF] = ERC_OUT
        elif (kind == w3.CONTINUED_12 or kind == w3.CONTINUED_4) and counts[PAYLOAD_OF] > 0:
            bits = counts[PAYLOAD_BITS]
            if kind == w3.CONTINUED_12 and bits < 24:
                counts[counts[PAYLOAD_OF]] += int64(word & 0xFFF) << bits
                counts[PAYLOAD_BITS] = bits + 12
            else:
                if kind == w3.CONTINUED_4 and bits == 24:
                    counts[counts[PAYLOAD_OF]] += int64(word & 0xF) << 24
                counts[PAYLOAD_OF] = 0
    counts[POLARITY] = polarity
