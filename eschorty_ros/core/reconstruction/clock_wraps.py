"""Whole wraps of the camera's clock between the events of a recording and its stage positions.

EVT3 carries 24 bits of a microsecond clock. A stream that begins later than 16.8 s after the
camera's start begins after an unknown number of wraps. It is decoded as if there were none.
"""

from __future__ import annotations

from eschorty_ros.core.evt3 import WRAP_US, Decoder, time_span_us
from eschorty_ros.core.storage import Recording
from eschorty_ros.core.storage.raw_file import RawReader

_CHUNK_BYTES = 1 << 19
_MAPPED_BYTES = 1 << 27
# Share of the shorter one of events and positions that both have to cover; they begin together.
_COVERED = 0.9
_TOGETHER_US = 2_000_000
# A camera is not on for longer; later times are of another clock.
_ON_US = 7 * 24 * 3_600_000_000


def in_wrap(recording: Recording) -> tuple[Recording, list[str]]:
    """Return the recording with its times in the wrap of its events, and a line where they change.

    They change where all of the stage's positions are after the events, and most are at their times
    when whole wraps are taken off.
    """
    first_us, last_us = recording.stage.first_us, recording.stage.last_us
    if first_us is None or last_us is None or first_us < WRAP_US // 2:
        return recording, []
    begin_us = _begin_us(recording)
    reader = RawReader(recording.events_path)
    span_us = sum(map(time_span_us, reader.mapped(_MAPPED_BYTES)))
    wraps = round((first_us - begin_us) / WRAP_US)
    off_us = wraps * WRAP_US
    both_us = min(begin_us + span_us, last_us - off_us) - max(begin_us, first_us - off_us)
    covered = both_us > _COVERED * min(span_us, last_us - first_us)
    together = abs(first_us - off_us - begin_us) < _TOGETHER_US and off_us < _ON_US
    if wraps < 1 or first_us <= begin_us + span_us or not (covered and together):
        return recording, []
    line = (
        f"the events begin {wraps} x 16.777216 s, wraps of the camera's 24-bit clock, before "
        "stage.csv; they are taken off the times of stage.csv and laser.yaml"
    )
    return recording.earlier(off_us), [line]


def _begin_us(recording: Recording) -> int:
    """Return the time of the first event, 0 without any."""
    reader = RawReader(recording.events_path)
    decoder = Decoder(reader.header.width, reader.header.height)
    for chunk in reader.chunks(_CHUNK_BYTES):
        events = decoder.decode(chunk)
        if len(events):
            return int(events.t[0])
    return 0
