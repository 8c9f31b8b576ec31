"""Decoded events as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import int64, types, uint8, uint16
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import entry_kernel
from eschorty_ros.core.base.numbers import integer

EVENT_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""One event, packed: time (us), column, row, polarity (1 = brighter)."""


class EventArrays(NamedTuple):
    """Time (us), column, row and polarity of events."""

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Triggers:
    """External trigger edges: ``t`` int64 us, ``channel`` uint8, ``edge`` uint8 (1 = rising)."""

    t: NDArray[np.int64]
    channel: NDArray[np.uint8]
    edge: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True, slots=True)
class Events:
    """Events in stream order; the arrays are views, valid until the maker's next call.

    ``t`` int64 us (never falls), ``x`` uint16 column, ``y`` uint16 row, ``p`` uint8 polarity.
    """

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]
    triggers: Triggers

    def __len__(self) -> int:
        return len(self.t)

    def packed(self) -> NDArray[np.void]:
        """Copy as one array of ``EVENT_DTYPE``."""
        records = np.empty(len(self.t), dtype=EVENT_DTYPE)
        records["t"], records["x"], records["y"], records["p"] = self.t, self.x, self.y, self.p
        return records


def event_arrays(size: int) -> EventArrays:
    """Return uninitialised arrays for ``size`` events."""
    integer("size", size, 0, 1 << 32)
    return EventArrays(
        np.empty(size, dtype=np.int64),
        np.empty(size, dtype=np.uint16),
        np.empty(size, dtype=np.uint16),
        np.empty(size, dtype=np.uint8),
    )


EVENT_ARRAYS = types.NamedTuple((int64[::1], uint16[::1], uint16[::1], uint8[::1]), EventArrays)
"""``EventArrays`` as kernels take them."""


@entry_kernel(int64(types.Array(int64, 1, "C", readonly=True), int64))
def _first_fall(t, last):
    """Return the index of the first time below its predecessor (``last`` for the first), or -1."""
    for k in range(t.size):
        if t[np.uintp(k)] < last:
            return k
        last = t[np.uintp(k)]
    return -1
