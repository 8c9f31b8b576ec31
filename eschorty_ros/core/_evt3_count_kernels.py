"""Compiled counting of EVT3 words; see ``evt3_count``."""

from __future__ import annotations

from numba import int64, njit, types, uint16

from eschorty_ros.core._bits import popcount64
from eschorty_ros.core._evt3_words import (
    ADDR_X,
    DROPPED_EVENTS,
    DROPPED_TIME_HIGH,
    DROPPED_TIME_LOW,
    EXT_TRIGGER,
    OTHERS,
    VECT_8,
    VECT_12,
    VECT_BASE_X,
)

OFF, ON, TRIGGERS, DROP_WORDS, POLARITY = range(5)

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
    counts[POLARITY] = polarity
