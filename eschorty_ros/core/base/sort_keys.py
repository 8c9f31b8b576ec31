"""Sort many integers by their digits."""

from __future__ import annotations

import numpy as np
from numba import int64, uint64, void
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import entry_kernel

_DIGIT_BITS = 8
_DIGITS = 1 << _DIGIT_BITS


def sort_keys(keys: NDArray[np.int64]) -> None:
    """Sort integers that are not negative, in place.

    The same as ``keys.sort()``, which takes four to five times as long where numpy uses AVX-512 on
    a processor that emulates part of it (AMD Zen 4).
    """
    _sort(keys, np.empty_like(keys))


@entry_kernel(void(int64[::1], int64[::1]))
def _sort(keys, spare):
    """Sort by one digit after another, from the lowest on; digits that all share cost nothing."""
    differing = np.int64(0)
    for key in keys:
        differing |= key ^ keys[0]
    place = np.empty(_DIGITS, np.int64)
    source, target = keys, spare
    for shift in range(0, 64, _DIGIT_BITS):
        if differing >> shift & (_DIGITS - 1):
            place[:] = 0
            for key in source:
                place[uint64(key >> shift & (_DIGITS - 1))] += 1
            before = 0
            for digit in range(uint64(_DIGITS)):
                count = place[digit]
                place[digit] = before
                before += count
            for key in source:
                digit = uint64(key >> shift & (_DIGITS - 1))
                target[uint64(place[digit])] = key
                place[digit] += 1
            source, target = target, source
    keys[:] = source
