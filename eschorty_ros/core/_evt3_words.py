"""EVT3 words: types, and the layout of the decoder's state and counters.

Source: Prophesee's public EVT 3.0 format description. A word is 16 bits, little-endian; the
type is bits 15..12, the payload bits 11..0.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

ADDR_Y = 0x0
LEGACY_Y = 0x1
ADDR_X = 0x2
VECT_BASE_X = 0x3
VECT_12 = 0x4
VECT_8 = 0x5
TIME_LOW = 0x6
CONTINUED_4 = 0x7
TIME_HIGH = 0x8
EXT_TRIGGER = 0xA
OTHERS = 0xE
CONTINUED_12 = 0xF

ERC_EVENTS_IN = 0x014
ERC_EVENTS_OUT = 0x016
DROPPED_TIME_LOW = 0xED6
DROPPED_TIME_HIGH = 0xED8
DROPPED_EVENTS = 0xEDA

TIME_HIGH_STEP_MAX = 100
"""Largest forward step of TIME_HIGH (4096 us each) taken without a second word confirming it."""

WORST_EVENTS_PER_WORD = 12

# Decoder state, one int64 each.
(
    S_RUN,
    S_EPOCH_US,
    S_HIGH,
    S_LOW,
    S_HELD,
    S_T_US,
    S_FLOOR_US,
    S_Y,
    S_LIMIT,
    S_BASE,
    S_VPOL,
    S_PHASE,
    S_OTHERS,
    S_SUBTYPE,
    S_PAYLOAD,
    S_COUNT,
) = range(16)

RUN_START = 0
RUN_GAP = 1
RUN_ON = 2

NO_BASE = 1 << 20
NO_Y = -1


@dataclass(frozen=True, slots=True)
class Counters:
    """What a decoder saw since it was made or reset; every dropped event is in ``events_dropped``.

    ``events``, ``triggers``
        Handed out.
    ``events_dropped``
        Events in the stream that were not handed out, for whatever reason.
    ``events_before_time``
        Of those: before the first TIME_HIGH (of the stream, or after a known gap).
    ``events_without_y``
        Of those: no valid ADDR_Y yet, or a row past the sensor's height.
    ``events_without_base``
        Of those: vectors before the first VECT_BASE_X.
    ``events_past_width``
        Of those: column past the sensor's width.
    ``words_before_time``
        Words of any type skipped before the first TIME_HIGH.
    ``x_without_y``, ``vectors_without_base``, ``vectors_past_width``, ``y_past_height``
        Words that break the grammar in this way.
    ``broken_triples``, ``broken_continuations``
        VECT_12 VECT_12 VECT_8 or OTHERS F F 7 sequences that were not whole.
    ``unknown_words``, ``legacy_y_words``
        Types 9, B, C, D; type 1.
    ``time_high_back``, ``time_high_jumps``, ``time_high_dropped``
        TIME_HIGH that stepped back; forward jump of more than 0.4 s confirmed by the next one;
        outlier the next one did not confirm.
    ``time_low_back``
        TIME_LOW below the time of an event handed out; time was held.
    ``others_words``
        OTHERS words of any subtype.
    ``sensor_dropped_time_low``, ``sensor_dropped_time_high``, ``sensor_dropped_events``
        The sensor said that its readout was saturated and it dropped such words.
    ``erc_events_in``, ``erc_events_out``
        Sums of the event counts before and after the sensor's event-rate controller.
    ``gaps``
        Calls of ``note_gap``.
    ``odd_byte``
        1 while half a word waits for its second byte.
    """

    events: int = 0
    triggers: int = 0
    events_dropped: int = 0
    events_before_time: int = 0
    events_without_y: int = 0
    events_without_base: int = 0
    events_past_width: int = 0
    words_before_time: int = 0
    x_without_y: int = 0
    vectors_without_base: int = 0
    vectors_past_width: int = 0
    y_past_height: int = 0
    broken_triples: int = 0
    broken_continuations: int = 0
    unknown_words: int = 0
    legacy_y_words: int = 0
    time_high_back: int = 0
    time_high_jumps: int = 0
    time_high_dropped: int = 0
    time_low_back: int = 0
    others_words: int = 0
    sensor_dropped_time_low: int = 0
    sensor_dropped_time_high: int = 0
    sensor_dropped_events: int = 0
    erc_events_in: int = 0
    erc_events_out: int = 0
    gaps: int = 0
    odd_byte: int = 0

    @property
    def sensor_drop_words(self) -> int:
        """All words by which the sensor reported a saturated readout."""
        return (
            self.sensor_dropped_time_low
            + self.sensor_dropped_time_high
            + self.sensor_dropped_events
        )


COUNTER_NAMES = tuple(f.name for f in fields(Counters))
(
    C_EVENTS,
    C_TRIGGERS,
    C_EVENTS_DROPPED,
    C_EVENTS_BEFORE_TIME,
    C_EVENTS_WITHOUT_Y,
    C_EVENTS_WITHOUT_BASE,
    C_EVENTS_PAST_WIDTH,
    C_WORDS_BEFORE_TIME,
    C_X_WITHOUT_Y,
    C_VECTORS_WITHOUT_BASE,
    C_VECTORS_PAST_WIDTH,
    C_Y_PAST_HEIGHT,
    C_BROKEN_TRIPLES,
    C_BROKEN_CONTINUATIONS,
    C_UNKNOWN_WORDS,
    C_LEGACY_Y_WORDS,
    C_TIME_HIGH_BACK,
    C_TIME_HIGH_JUMPS,
    C_TIME_HIGH_DROPPED,
    C_TIME_LOW_BACK,
    C_OTHERS_WORDS,
    C_SENSOR_DROPPED_TIME_LOW,
    C_SENSOR_DROPPED_TIME_HIGH,
    C_SENSOR_DROPPED_EVENTS,
    C_ERC_EVENTS_IN,
    C_ERC_EVENTS_OUT,
    C_GAPS,
    C_ODD_BYTE,
) = range(len(COUNTER_NAMES))


def initial_state() -> NDArray[np.int64]:
    """State of a decoder that has seen nothing."""
    state = np.zeros(S_COUNT, dtype=np.int64)
    state[S_HELD] = -1
    state[S_Y] = NO_Y
    state[S_BASE] = NO_BASE
    return state
