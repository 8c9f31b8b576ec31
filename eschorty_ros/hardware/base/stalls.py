"""How long this process itself stood still: time in which others' silence says nothing."""

from __future__ import annotations

import time

LEAST_S = 0.1


class OwnPauses:
    """Measures by how much a loop's looks come late.

    A machine that stands still (it swaps, or is a virtual one that is not run) makes every sign of
    life grow old at once. Whoever judges silence leaves that time out; what dies is noticed by
    other means than its silence. Judge it as of ``looked_s``: a pause may begin after a look.

    Parameters
    ----------
    period_s : float
        How often the loop looks.

    Attributes
    ----------
    looked_s : float
        Time of the last look, steady clock.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self.looked_s = time.monotonic()

    def look(self) -> float:
        """Look; returns the seconds by which it is late, 0 when they are fewer than 0.1."""
        before_s, self.looked_s = self.looked_s, time.monotonic()
        late_s = self.looked_s - before_s - self._period_s
        return late_s if late_s >= LEAST_S else 0.0
