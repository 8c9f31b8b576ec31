"""The clocks of two nodes, compared by the stamps of one and the arrivals at the other."""

from __future__ import annotations

import time
from collections import deque

from eschorty_ros.control.scan_sequence import ScanFailure

_WINDOW_S = 1.0
# On a busy computer every message of a second may come late; none comes before its stamp.
_AHEAD_MAX_S, _BEHIND_MAX_S = 0.1, 0.5


class StampAges:
    """Ages of a node's messages on arrival: the least one of a second is the clocks' difference.

    - ``name``: The node, for messages.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._ages: deque[tuple[float, float]] = deque(maxlen=1000)

    def add(self, age_s: float) -> None:
        """Add a message that arrived ``age_s`` after its stamp."""
        self._ages.append((time.monotonic(), age_s))

    def least_s(self) -> float | None:
        """Return the least age of the last second, ``None`` without messages."""
        begin_s = time.monotonic() - _WINDOW_S
        return min((age_s for at_s, age_s in list(self._ages) if at_s >= begin_s), default=None)

    def check(self) -> None:
        """Raise ``ScanFailure`` with the difference when the clocks are not of one time."""
        age_s = self.least_s()
        if age_s is None or -_AHEAD_MAX_S <= age_s <= _BEHIND_MAX_S:
            return
        difference = f"{abs(age_s):.3f} s {'ahead of' if age_s < 0.0 else 'behind'}"
        # An emulated device on a busy computer is late.
        late = "" if age_s < 0.0 else ", or run less beside an emulated instrument"
        raise ScanFailure(
            f"{self._name}: its stamps are {difference} this host's clock; "
            f"synchronise the hosts' clocks, leave use_sim_time out{late}"
        )
