"""What can be set on the simulated sensor while it runs, over sensor time."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field

from eschorty_ros.simulation.pixels import Biases
from eschorty_ros.simulation.readout import EventRate


@dataclass(frozen=True, slots=True)
class SensorControl:
    """Settings of the sensor; the defaults are its factory's.

    Parameters
    ----------
    biases : Biases
    event_rate : EventRate or None
        Limit of the event-rate control, ``None`` when it is off.
    """

    biases: Biases = field(default_factory=Biases)
    event_rate: EventRate | None = None


class ControlTimeline:
    """Settings, each from its time on."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._controls: list[SensorControl] = []

    def set(self, t_us: int, control: SensorControl) -> None:
        """Hold ``control`` from ``t_us`` on; replaces what was set for later times."""
        keep = len([t for t in self._times if t < t_us])
        self._times[keep:] = [t_us]
        self._controls[keep:] = [control]

    def due(self, t_us: int) -> SensorControl | None:
        """Take the settings that begin by ``t_us``, the last of them; ``None`` without any."""
        k = bisect_right(self._times, t_us)
        due = self._controls[k - 1] if k else None
        del self._times[:k], self._controls[:k]
        return due

    def next_us(self, otherwise_us: int) -> int:
        """Time of the next change, at most ``otherwise_us``."""
        return min(self._times[0], otherwise_us) if self._times else otherwise_us
