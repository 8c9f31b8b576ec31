"""The data stream of the EVK4: the sensor's words without masked pixels."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import words as w3

_VECTOR_BITS = 12


class SensorSource(Protocol):
    """The source of the pixels' words; thread-safe.

    ``start`` and ``stop`` come from the control thread while ``read`` may be waiting.
    """

    def start(self) -> None:
        """Start; sensor time is 0."""

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """Return the words of the packets sent by now, ``b""`` when none come in ``timeout_s``."""

    def stop(self) -> None:
        """Stop."""


class PixelMask:
    """Removes masked pixels from EVT3 words; keeps row and vector base across calls.

    - ``columns_off``, ``rows_off``: A pixel is off when its column or its row is.
    - ``pixels_off``: Single pixels.
    """

    def __init__(
        self,
        columns_off: Iterable[int],
        rows_off: Iterable[int],
        pixels_off: Iterable[tuple[int, int]],
    ):
        self._columns = np.zeros(w3.ADDRESSES + _VECTOR_BITS, bool)
        self._columns[list(columns_off)] = True
        self._rows = np.zeros(w3.ADDRESSES, bool)
        self._rows[list(rows_off)] = True
        self._pixels = tuple(pixels_off)
        # Bit i of entry x: column x + i is on.
        shifted = [~self._columns[i : i + w3.ADDRESSES] for i in range(_VECTOR_BITS)]
        self._on_bits = np.zeros(w3.ADDRESSES, np.uint16)
        for bit, on in enumerate(shifted):
            self._on_bits |= on.astype(np.uint16) << bit
        self._row = 0
        self._base = 0

    def __bool__(self) -> bool:
        return bool(self._columns.any() or self._rows.any() or self._pixels)

    def apply(self, data: bytes) -> bytes:
        """Return the words without the events of masked pixels."""
        words = np.frombuffer(data, np.dtype("<u2")).copy()
        kinds, payload = words >> 12, words & 0x7FF
        rows = self._rows_at(kinds == w3.ADDR_Y, payload, self._row)
        bases = self._bases_at(kinds, payload)
        vectors = (kinds == w3.VECT_12) | (kinds == w3.VECT_8)
        singles = kinds == w3.ADDR_X
        off = self._rows[rows]
        lost = singles & (off | self._columns[payload])
        words[vectors & off] &= 0xF000
        words[vectors] &= 0xF000 | self._on_bits[bases[vectors] % w3.ADDRESSES]
        for column, row in self._pixels:
            here = rows == row
            lost |= singles & here & (payload == column)
            bit = column - bases
            hit = vectors & here & (bit >= 0) & (bit < _VECTOR_BITS)
            words[hit] &= ~(np.uint16(1) << bit[hit].astype(np.uint16))
        return words[~lost].tobytes()

    def _rows_at(
        self, given: NDArray[np.bool_], payload: NDArray[np.integer], before: int
    ) -> NDArray[np.int64]:
        """Return the row in force at each word."""
        last = np.maximum.accumulate(np.where(given, np.arange(len(given)), -1))
        rows = np.where(last >= 0, payload[last], before).astype(np.int64)
        if len(rows):
            self._row = int(rows[-1])
        return rows

    def _bases_at(
        self, kinds: NDArray[np.integer], payload: NDArray[np.integer]
    ) -> NDArray[np.int64]:
        """Return the column of bit 0 at each word; a vector advances it by its width."""
        steps = np.where(kinds == w3.VECT_12, 12, np.where(kinds == w3.VECT_8, 8, 0))
        moved = np.cumsum(steps) - steps
        given = kinds == w3.VECT_BASE_X
        last = np.maximum.accumulate(np.where(given, np.arange(len(kinds)), -1))
        start = np.where(last >= 0, payload[last].astype(np.int64) - moved[last], self._base)
        bases = start + moved
        if len(bases):
            self._base = int(bases[-1] + steps[-1])
        return bases


def without_triggers(data: bytes) -> bytes:
    """Return the words without trigger words."""
    words = np.frombuffer(data, np.dtype("<u2"))
    return words[words >> 12 != w3.EXT_TRIGGER].tobytes()
