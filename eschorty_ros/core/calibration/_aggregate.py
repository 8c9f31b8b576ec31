"""Compiled counting of events per pixel; see ``aggregate_frame``."""

from __future__ import annotations

from numba import int64, types, uint16, uint32

from eschorty_ros.core.base.kernel import kernel

COUNT_MAX = (1 << 32) - 1

_U2 = types.Array(uint16, 1, "C", readonly=True)


@kernel(int64(uint32[:, ::1], _U2, _U2))
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
