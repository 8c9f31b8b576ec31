"""Pixels that go on under other biases; see ``PixelArray.change``."""

from __future__ import annotations

import math

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.simulation.pixels._passage import GAP_MAX
from eschorty_ros.simulation.pixels._pixel import HELD, WAITS
from eschorty_ros.simulation.pixels._response import _advanced, _earliest_us


@kernel
def _rebias(pixels, spans, due, t_us, before, after):
    """Anchor every pixel anew at ``t_us``, up to which ``_run_columns`` has been.

    ``before`` and ``after`` are the ``model`` of ``_live``; the pixels' thresholds are the new
    ones already. Signals are those that the old biases left; an event that would
    have come later is looked for anew, and a dead time that has begun ends when it was to end.
    """
    reach = math.exp(GAP_MAX * after[2])
    rows = pixels.shape[1]
    for column in range(pixels.shape[0]):
        lo, hi, earliest = rows, 0, np.inf
        for row in range(rows):
            pixel = pixels[np.uintp(column), np.uintp(row)]
            u, y, y_ref, settled = pixel.u, pixel.y, pixel.y_ref, pixel.u_settled
            # Never lit: it has nothing to go on with.
            if pixel.t_next == np.inf and u == settled and y == settled and y_ref == settled:
                continue
            held = pixel.state == HELD
            elapsed_us = t_us - pixel.t
            tau_us = settled / before[0]
            u, y = _advanced(u, y, settled, tau_us, before[1], elapsed_us)
            pixel.u, pixel.y, pixel.t = u, y, t_us
            if not held:
                pixel.state = WAITS
                on_level = y_ref * np.float64(pixel.on_factor)
                off_level = y_ref * np.float64(pixel.off_factor)
                pixel.t_next = _earliest_us(
                    u, y, settled, t_us, settled / after[0], after[1], on_level, off_level, reach
                )
            if pixel.t_next < np.inf:
                lo, hi = min(lo, row), row + 1
                earliest = min(earliest, pixel.t_next)
        spans[column, 2], spans[column, 3] = min(lo, hi), hi
        due[column] = earliest
