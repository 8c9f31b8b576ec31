"""Counts of a decoder."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class Counters:
    """Counts of a decoder since it was made."""

    events: int = 0
    """Returned, as are ``triggers``."""
    triggers: int = 0
    events_dropped: int = 0
    """In the stream and not returned, for whatever reason; of those:"""
    events_before_time: int = 0
    """Before the first TIME_HIGH of the stream or after a known gap."""
    events_without_y: int = 0
    """Without a valid ADDR_Y, or in a row past the sensor's height."""
    events_without_base: int = 0
    """In vectors before the first VECT_BASE_X."""
    events_past_width: int = 0
    words_before_time: int = 0
    """Words of any type skipped before the first TIME_HIGH."""
    x_without_y: int = 0
    """Words that break the grammar in this way, as the next three."""
    vectors_without_base: int = 0
    vectors_past_width: int = 0
    y_past_height: int = 0
    broken_triples: int = 0
    """Incomplete sequences VECT_12 VECT_12 VECT_8."""
    broken_continuations: int = 0
    """Incomplete sequences OTHERS F F 7."""
    unknown_words: int = 0
    legacy_y_words: int = 0
    time_high_back: int = 0
    time_high_jumps: int = 0
    """Forward jumps of more than 12 ms that the next two TIME_HIGH confirmed."""
    time_high_dropped: int = 0
    """Those that they did not confirm."""
    time_low_back: int = 0
    """TIME_LOW below the time of an event already returned; time was held."""
    others_words: int = 0
    sensor_dropped_time_low: int = 0
    """The sensor's reports that its saturated readout dropped words, as the next two."""
    sensor_dropped_time_high: int = 0
    sensor_dropped_events: int = 0
    erc_events_in: int = 0
    """Sum of the event counts before the sensor's event-rate controller."""
    erc_events_out: int = 0
    """And after it."""
    gaps: int = 0
    """Calls of ``note_gap``."""
    odd_byte: int = 0
    """1 while half a word waits for its second byte."""

    @property
    def broken_words(self) -> int:
        """All words that break the grammar or the order of TIME_HIGH."""
        return (
            self.x_without_y
            + self.vectors_without_base
            + self.vectors_past_width
            + self.y_past_height
            + self.broken_triples
            + self.broken_continuations
            + self.unknown_words
            + self.time_high_back
            + self.time_high_dropped
        )

    @property
    def sensor_drop_words(self) -> int:
        """All words by which the sensor reported a saturated readout."""
        return (
            self.sensor_dropped_time_low
            + self.sensor_dropped_time_high
            + self.sensor_dropped_events
        )


COUNTS = tuple(f.name for f in fields(Counters) if f.name != "odd_byte")
