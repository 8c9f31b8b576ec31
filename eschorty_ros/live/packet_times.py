"""Event packets and the sensor time at their beginning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.clocks import NS_PER_US
from eschorty_ros.core.evt3 import WRAP_US, begin_time, first_time_high_us, time_span_us

# A decoder follows the 24-bit time over gaps of less than half a wrap.
GAP_NS = WRAP_US * NS_PER_US // 2
# A stream without losses skips less of its own time than this between two packets.
_STEP_US = 100_000
# Where packets got lost the host may have stalled, and its stamps be late, by less than this.
_STALL_US = 2_000_000
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


class TimeHigh(NamedTuple):
    """Time of a packet's first TIME_HIGH, us modulo the wrap, and the packet's stamp."""

    t_us: int
    stamp_ns: int


def newest_high(packet: Packet, before: TimeHigh | None) -> TimeHigh | None:
    """Return the first TIME_HIGH of a packet, ``before`` where it has none or a broken one."""
    high_us = first_time_high_us(packet.data)
    if high_us is None or (before is not None and _is_broken(packet.data, before.t_us)):
        return before
    return TimeHigh(high_us, packet.stamp_ns)


def restarts_time(packet: Packet, before: TimeHigh | None, lost: bool) -> bool:
    """Return whether sensor time starts again with this packet, though its number goes on.

    Sensor time, modulo its wrap, then makes a step that the stamps do not. ``before`` is the last
    one known, ``lost`` is true where packets are missing since.
    """
    if before is None or not skips_time(packet.data, before.t_us):
        return False
    if _is_broken(packet.data, before.t_us):
        return False
    high_us = first_time_high_us(packet.data)
    assert high_us is not None
    step_us = high_us - before.t_us - (packet.stamp_ns - before.stamp_ns) // NS_PER_US
    apart_us = (step_us + WRAP_US // 2) % WRAP_US - WRAP_US // 2
    return abs(apart_us) > (_STALL_US if lost else _STEP_US)


def _is_broken(data: Any, before_us: int) -> bool:
    """Return whether the first TIME_HIGH is off ``before_us`` and the next one off the first."""
    return skips_time(data, before_us) and time_span_us(data) > _STEP_US


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
