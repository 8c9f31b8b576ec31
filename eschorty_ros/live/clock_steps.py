"""Steps of the computer's clock, seen beside one that is never set."""

from __future__ import annotations

# Slewing moves a clock by less between two looks; a stage at 100 mm/s moves by a millimetre.
_STEP_NS = 10_000_000
# Packets stamped before a step have been handled when it is reported again.
_AGAIN_S = 0.5


class ClockSteps:
    """Reports every step of a clock at once and again half a second later."""

    def __init__(self) -> None:
        self._lead_ns: int | None = None
        self._step_ns = 0
        self._again_s = 0.0

    def step_ns(self, lead_ns: int, now_s: float) -> int:
        """Return how far the clock was set, 0 where there is nothing to report.

        - ``lead_ns``: Lead of the clock over the steady one.
        - ``now_s``: Steady clock.
        """
        before_ns, self._lead_ns = self._lead_ns, lead_ns
        if before_ns is not None and abs(lead_ns - before_ns) > _STEP_NS:
            self._step_ns, self._again_s = lead_ns - before_ns, now_s + _AGAIN_S
            return self._step_ns
        if self._step_ns and now_s >= self._again_s:
            step_ns, self._step_ns = self._step_ns, 0
            return step_ns
        return 0
