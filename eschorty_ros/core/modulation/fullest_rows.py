"""Where the line is, among background, before its rows are known: the fullest rows of near columns.

A lamp that flickers gives events in all rows, several times as many as the line. The line adds to
those of its rows, and the others show how many the lamp gives at any time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Cells of 16 x 16 pixels; a line is in the fullest one of its columns and those beside.
_CELL_BITS = 4
_NEAR_CELLS = 1
NEAR_ROWS = (2 * _NEAR_CELLS + 1) << _CELL_BITS
"""Rows near the fullest ones."""


class FullestRows(NamedTuple):
    """The cell of each event's column, whether its row is near the fullest there, other rows."""

    cell: NDArray[np.int64]
    near: NDArray[np.bool_]
    far_rows: int

    @property
    def weights(self) -> NDArray[np.float64]:
        """Return 1 for near events, and for others what takes off the background of those."""
        return np.where(self.near, 1.0, -NEAR_ROWS / max(self.far_rows, NEAR_ROWS))


def fullest_rows(column: NDArray[np.uint16], row: NDArray[np.uint16]) -> FullestRows:
    """Return where events are; shape (n,), at least one."""
    across = (column >> _CELL_BITS).astype(np.int64)
    along = (row >> _CELL_BITS).astype(np.int64)
    shape = int(across.max()) + 1, int(along.max()) + 1
    counts = np.bincount(across * shape[1] + along, minlength=shape[0] * shape[1]).reshape(shape)
    near = np.abs(along - counts.argmax(axis=1)[across]) <= _NEAR_CELLS
    return FullestRows(across, near, max((shape[1] << _CELL_BITS) - NEAR_ROWS, 0))
