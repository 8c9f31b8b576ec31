"""Compiled counting of events per pixel; see ``aggregate_frame``."""

from __future__ import annotations

from numba import int64, njit, types, uint16, uint32

COUNT_MAX = (1 << 32) - 1

_U2 = types.Array(uint16, 1, "C", readonly=True)


@njit(int64(uint32[:, ::1], _U2, _U2), cache=True, nogil=True)
def count_events(counts, x, y):
    """Add each event to its pixel; how many lay outside. A full pixel stays full."""
    rows, columns = counts.shape
    outside = 0
    for i in range(x.size):
        if y[i] < rows and x[i] < columns:
            if counts[y[i], x[i]] < COUNT_MAX:
                counts[y[i], x[i]] += uint32(1)
        else:
            outside += 1
    return outside
