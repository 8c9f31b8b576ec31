"""Event packets and the sensor time at their beginning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.clocks import NS_PER_US
from eschorty_ros.core.evt3 import WRAP_US, begin_time, first_time_high_us, time_span_us

# A decoder follows the 24-bit time over gaps of less than half a wrap.
GAP_NS = WRAP_US * NS_PER_US // 2
# A stream without losses skips less of its own time than this between two packets.
_STEP_US = 100_000
# A packet at most this many numbers back that is stamped no later was overtaken in transit.
_OVERTAKEN = 16
# A broken word adds one wrap; a packet holds some milliseconds.
_SPAN_MAX_US = 4 * WRAP_US


@dataclass(frozen=True, slots=True)
class Packet:
    """One ``EventPacket``: ``data`` is a buffer of EVT3 words, ``stamp_ns`` its arrival time.

    ``source`` identifies its publisher, ``b""`` where that is unknown.
    """

    seq: int
    stamp_ns: int
    data: Any
    source: bytes = b""


def check_span(data: Any) -> None:
    """Raise ``FormatError`` for a packet whose time runs on for longer than any packet lasts."""
    span_us = time_span_us(data)
    if span_us > _SPAN_MAX_US:
        raise FormatError(
            f"a packet of {len(data)} bytes spans {span_us * 1e-6:.0f} s; send EVT3 as it comes"
        )


def first_time_us(data: Any, before_us: int | None, after_us: int | None) -> int | None:
    """Return the latest known sensor time at or before a packet's first bytes.

    - ``before_us``, ``after_us``: Times the decoder had reached before and after the packet; a time
      outside comes from a broken word.
    """
    t_us = _first_word_us(data, before_us)
    if after_us is None or (t_us is not None and (before_us or 0) <= t_us <= after_us):
        return t_us
    return before_us


def overtaken(packet: Packet, next_seq: int | None, last_stamp_ns: int) -> bool:
    """Return whether a packet came twice or too late, as opposed to a restart of the stream."""
    if next_seq is None or packet.stamp_ns > last_stamp_ns:
        return False
    return 0 < packet.seq < next_seq <= packet.seq + _OVERTAKEN


def skips_time(data: Any, before_us: int | None) -> bool:
    """Return whether part of the stream is missing between ``before_us`` and this packet.

    Packets that a stalled host stamped late are continuous in sensor time. A missing part need
    not show in ``seq``: a driver numbers what it sends, and sends nothing without a subscriber.
    """
    high_us = first_time_high_us(data)
    if high_us is None or before_us is None:
        return False
    return _STEP_US < (high_us - (before_us & ~0xFFF)) % WRAP_US < WRAP_US - _STEP_US


def _first_word_us(data: Any, before_us: int | None) -> int | None:
    high, low = begin_time(data)
    if high >= 0:
        t_us = high << 12
    elif low >= 0 and before_us is not None:
        t_us = before_us & ~0xFFF
    else:
        return None
    t_us |= max(low, 0)
    if before_us is None:
        return t_us
    return t_us + round((before_us - t_us) / WRAP_US) * WRAP_US
