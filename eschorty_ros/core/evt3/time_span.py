"""Begin and length of a piece of an EVT3 stream by its own time words, without decoding it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import int64, types, uint16
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import byte_view
from eschorty_ros.core.base.kernel import entry_kernel, kernel
from eschorty_ros.core.evt3 import words as w3

WRAP_US = 1 << 24
"""The sensor's time in EVT3 is modulo this."""
# Words searched at once; TIME_HIGH is one of some hundred.
_BLOCK = 64
# A stream repeats its time far more often.
_SEARCHED = 8192
_WORDS = types.Array(uint16, 1, "C", readonly=True)


class BeginTime(NamedTuple):
    """Payloads of the first TIME_LOW and of the last TIME_HIGH before it; -1 where there is none.

    One of TIME_HIGH counts 4096 us and wraps at 2^24 us, one of TIME_LOW 1 us.
    """

    high: int
    low: int


def begin_time(data: bytes | bytearray | memoryview) -> BeginTime:
    """Return when a piece of a stream begins by the time words among its first 8192.

    Raises ``ArgumentError`` for anything but bytes.
    """
    return BeginTime(*_begin(_words(data)[:_SEARCHED]))


def first_time_high_us(data: bytes | bytearray | memoryview) -> int | None:
    """Return the time of the first TIME_HIGH word, us modulo 2^24, ``None`` without one.

    Raises ``ArgumentError`` for anything but bytes.
    """
    words = _words(data)
    found = np.flatnonzero(words >> 12 == w3.TIME_HIGH)
    return int(words[found[0]] & 0xFFF) << 12 if found.size else None


def time_span_us(data: bytes | bytearray | memoryview) -> int:
    """Return the sum of the steps of all TIME_HIGH words, us, each taken as forward.

    A step back so counts as a wrap of the 24-bit time less that step: a multiple of 4096 us that
    is far longer than a packet where the words are no stream. A single last byte is left out.

    Raises ``ArgumentError`` for anything but bytes.
    """
    return int(_steps(_words(data))) << 12


def _words(data: bytes | bytearray | memoryview) -> NDArray[np.uint16]:
    view = byte_view("data", data)
    words = np.frombuffer(view[: len(view) & ~1], "<u2")
    return words if words.flags.aligned else words.copy()


@entry_kernel(types.UniTuple(int64, 2)(_WORDS))
def _begin(words):
    """Return the payloads of the first TIME_LOW and of the last TIME_HIGH before it, or -1."""
    high = -1
    for word in words:
        if word >> 12 == w3.TIME_HIGH:
            high = int64(word & 0xFFF)
        elif word >> 12 == w3.TIME_LOW:
            return high, int64(word & 0xFFF)
    return high, -1


@kernel(_nrt=False)
def _has_time(words, begin):
    """Return whether one of a block of words is a TIME_HIGH, without a branch for each."""
    found = np.uint32(0)
    for k in range(np.uintp(_BLOCK)):
        kind = np.uint32(np.uint32(words[begin + k]) >> np.uint32(12))
        found = np.uint32(found | np.uint32(kind == w3.TIME_HIGH))
    return found > 0


@entry_kernel(int64(_WORDS))
def _steps(words):
    """Return the sum of the steps of the payloads of TIME_HIGH, modulo 4096 each."""
    total, last = 0, -1
    size, begin = np.uintp(words.size), np.uintp(0)
    while begin < size:
        end = begin + np.uintp(_BLOCK)
        if end > size or _has_time(words, begin):
            for k in range(begin, min(end, size)):
                if words[k] >> 12 == w3.TIME_HIGH:
                    high = int64(words[k] & 0xFFF)
                    total += (high - last) & 0xFFF if last >= 0 else 0
                    last = high
        begin = end
    return total
