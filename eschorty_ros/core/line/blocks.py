"""Blocks of columns, of which a stream keeps one set of sums each."""

from __future__ import annotations

import numpy as np

from eschorty_ros.core.base.kernel import kernel

# Columns of a block; the differences of a block and its two neighbours count for its points.
BLOCK_COLUMNS = 16


@kernel(inline="always")
def _near_sum(sums, block):
    """Return the sum over a block and its two neighbours."""
    b = np.uintp(block)
    return sums[b - np.uintp(1)] + sums[b] + sums[b + np.uintp(1)]
