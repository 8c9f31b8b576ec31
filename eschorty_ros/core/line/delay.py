"""How much later than the light a line's events are, from the stream itself.

Pixels answer both edges of the laser late, and a line that moves while it is lit gives its events
in between. A row is the mean over all of them, so it is where the line was in the middle of the
light: turned round in time, the same motion gives the same pixels as many events. The events' mean
time is later by what the pixels need, which is the same for all columns but for their noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.modulation import Modulation

# Before this many points their mean time is not known to a sixteenth of its scatter.
_POINTS_MIN = 256
# A larger one, us or share of the period, is an error of the phase.
_DELAY_MAX_US = 1000.0
_DELAY_MAX_SHARE = 0.25


class Light(NamedTuple):
    """When a profile is lit, and the largest delay of its events that is applied.

    ``middle_us`` is from the first edge to the middle of the light, ``lit_share`` the share of the
    profile's time with light. Delays larger than ``delay_max_us`` are not applied; -1 applies none.
    """

    middle_us: float = 0.0
    lit_share: float = 1.0
    delay_max_us: float = -1.0


def make_light(modulation: Modulation, every: int) -> Light:
    """Return the light of profiles of ``every`` periods."""
    period_us = modulation.period_us
    return Light(
        middle_us=modulation.middle_us + 0.5 * (every - 1) * period_us,
        lit_share=(every - 1 + modulation.duty) / every,
        delay_max_us=max(_DELAY_MAX_US, _DELAY_MAX_SHARE * period_us),
    )


@kernel
def _delay_us(rows, sums, light):
    """Add the points of a profile and return the delay of the events, us; 0 while it is unknown.

    ``sums`` are those of the points' mean times since their edge, us, and their number.
    """
    returns, columns = rows.row.shape
    total_us, points = np.int64(0), np.int64(0)
    for k in range(returns):
        for c in range(np.uintp(columns)):
            found = not np.isnan(rows.row[k, c])
            total_us += rows.mean_dt_us[k, c] if found else np.int64(0)
            points += np.int64(found)
    sums.time_us += total_us
    sums.points += points
    late_us = sums.time_us / max(sums.points, 1) - light.middle_us
    known = sums.points >= _POINTS_MIN and abs(late_us) <= light.delay_max_us
    return np.int64(np.rint(late_us)) if known else np.int64(0)
