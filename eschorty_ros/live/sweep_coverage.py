"""The profiles that a sweep should give, from the stage's motion between two positions."""

from __future__ import annotations

import math

import numpy as np

PASSES_MAX = 255
"""Most passes of a scan, as the action's goal can state them."""
COMPLETE = 0.98
"""Share of the profiles from which a scan is complete: at its ends a period may be cut."""


class SweepCoverage:
    """Adds up the stage's motion between two positions.

    - ``passes``: Times that the stage goes from one to the other.
    """

    def __init__(self, start_mm: float, stop_mm: float, passes: int = 1) -> None:
        self._passes = passes
        self._low_mm, self._high_mm = min(start_mm, stop_mm), max(start_mm, stop_mm)
        self._last: tuple[int, float] | None = None
        self._steps: list[tuple[float, float]] = []
        self._inside_s = 0.0

    def add(self, t_ns: int, position_mm: float) -> None:
        """Add a stage sample at ROS time ``t_ns``."""
        before_ns, before_mm = self._last or (t_ns, position_mm)
        self._last = t_ns, position_mm
        step_s = (t_ns - before_ns) * 1e-9
        if step_s <= 0.0:
            return
        if position_mm == before_mm:
            self._inside_s += step_s * (self._low_mm <= position_mm <= self._high_mm)
            return
        ends_mm = np.clip((before_mm, position_mm), self._low_mm, self._high_mm)
        inside_mm = abs(float(ends_mm[1] - ends_mm[0]))
        if inside_mm > 0.0:
            inside_s = step_s * inside_mm / abs(position_mm - before_mm)
            self._inside_s += inside_s
            self._steps.append((inside_s, inside_mm))

    def profiles_max(self, profile_rate_hz: float) -> int:
        """Return the profiles that the time between the positions allows, with rests."""
        return math.ceil(self._inside_s * profile_rate_hz)

    def profiles(self, profile_rate_hz: float) -> int:
        """Return the whole profiles of all passes over the whole distance, 0 without motion.

        The profiles that its ends cut are not counted. The speed is the median over the distance:
        neither rests nor late samples shift it.
        """
        if not self._steps:
            return 0
        time_s, distance_mm = np.array(self._steps).T
        speed_mm_s = distance_mm / time_s
        order = np.argsort(speed_mm_s)
        covered_mm = np.cumsum(distance_mm[order])
        median_mm_s = speed_mm_s[order[np.searchsorted(covered_mm, 0.5 * covered_mm[-1])]]
        profiles = (self._high_mm - self._low_mm) / median_mm_s * profile_rate_hz
        return self._passes * max(round(profiles) - 1, 0)
