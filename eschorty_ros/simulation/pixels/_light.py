"""Light of the laser line on the rows of a column."""

from __future__ import annotations

import math

import numpy as np

from eschorty_ros.core.base.kernel import kernel


@kernel
def _window(patch, sigma, least, rows):
    """Rows [lo, hi) in which a patch adds at least ``least``; (0, 0) for none."""
    line_row, contrast = patch[0], patch[1]
    if not (contrast > least and abs(line_row) < 1e6):
        return 0, 0
    half = sigma * math.sqrt(2.0 * math.log(contrast / least))
    first = max(math.ceil(line_row - half), math.floor(max(patch[2] + 0.5, 0.0)))
    last = min(math.floor(line_row + half), math.ceil(min(patch[3] - 0.5, rows - 1.0)))
    lo = min(max(0, first), rows)
    return (lo, min(rows, last + 1)) if lo <= last else (0, 0)


@kernel
def _add_patch(light, lo, hi, patch, sigma):
    """Add a patch of the footprint to ``light`` in rows [lo, hi): a Gaussian by recurrence.

    ``patch`` = row of the line, contrast there, and the rows between which it is lit; a row that
    is lit in part gets its share.
    """
    offset = lo - patch[0]
    value = patch[1] * math.exp(-0.5 * offset * offset / (sigma * sigma))
    ratio = math.exp(-(offset + 0.5) / (sigma * sigma))
    step_ratio = math.exp(-1.0 / (sigma * sigma))
    for row in range(lo, hi):
        share = min(1.0, min(row + 0.5 - patch[2], patch[3] - row + 0.5))
        light[np.uintp(row)] += max(0.0, share) * value
        value *= ratio
        ratio *= step_ratio
