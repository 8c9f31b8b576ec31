"""Compiled counting of EVT3 words; see ``evt3_count``."""

from __future__ import annotations

from numba import int64, njit, types, uint16

from eschorty_ros.core._bits import popcount64
from eschorty_ros.core._evt3_words import (
    ADDR_X,
    CONTINUED_4,
    CONTINUED_12,
    DROPPED_EVENTS,
    DROPPED_TIME_HIGH,
    DROPPED_TIME_LOW,
    ERC_EVENTS_IN,
    ERC_EVENTS_OUT,
    EXT_TRIGGER,
    OTHERS,
    VECT_8,
    VECT_12,
    VECT_BASE_X,
)

# The last three are state: polarity of vectors, which count a payload belongs to (0 for none), and
# the bits of it that have come.
OFF, ON, TRIGGERS, DROP_WORDS, ERC_IN, ERC_OUT, POLARITY, PAYLOAD_OF, PAYLOAD_BITS = range(9)
SIZE = 9

_U2 = types.Array(uint16, 1, "C", readonly=True)


@njit(types.void(_U2, int64[::1]), cache=True, nogil=True)
def count_words(words, counts):
    """Add up events by polarity, triggers and the sensor's own loss reports."""
    polarity = counts[POLARITY]
    for word in words:
        kind = word >> 12
        if kind == VECT_12:
            counts[polarity] += int64(popcount64(word & 0xFFF))
        elif kind == VECT_8:
            counts[polarity] += int64(popcount64(word & 0xFF))
        elif kind == ADDR_X:
            counts[word >> 11 & 1] += 1
        elif kind == VECT_BASE_X:
            polarity = int64(word >> 11 & 1)
        elif kind == EXT_TRIGGER:
            counts[TRIGGERS] += 1
        elif kind == OTHERS:
            subtype = word & 0xFFF
            if (
                subtype == DROPPED_TIME_LOW
                or subtype == DROPPED_TIME_HIGH
                or subtype == DROPPED_EVENTS
            ):
                counts[DROP_WORDS] += 1
            counts[PAYLOAD_BITS] = 0
            counts[PAYLOAD_OF] = 0
            if subtype == ERC_EVENTS_IN:
                counts[PAYLOAD_OF] = ERC_IN
            elif subtype == ERC_EVENTS_OUT:
                counts[PAYLOAD_OF] = ERC_OUT
        elif (kind == CONTINUED_12 or kind == CONTINUED_4) and counts[PAYLOAD_OF] > 0:
            bits = counts[PAYLOAD_BITS]
            if kind == CONTINUED_12 and bits < 24:
                counts[counts[PAYLOAD_OF]] += int64(word & 0xFFF) << bits
                counts[PAYLOAD_BITS] = bits + 12
            else:
                if kind == CONTINUED_4 and bits == 24:
                    counts[counts[PAYLOAD_OF]] += int64(word & 0xF) << 24
                counts[PAYLOAD_OF] = 0
    counts[POLARITY] = polarity
