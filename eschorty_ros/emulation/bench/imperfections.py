"""Deviations of the emulated bench from an ideal one."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from eschorty_ros.core.base.numbers import number

_PPB = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Imperfections:
    """Deviations of the bench from an ideal one.

    Parameters
    ----------
    sensor_ppm, generator_ppm : float
        Rate error of the sensor's and the generator's clock.
    usb_jitter_ms : float
        Largest delay of the camera's bytes, uniformly distributed from 0.
    missing_edges : float
        Share of the trigger edges that the camera does not see.
    seed : int
        Seed of jitter and missing edges.

    Raises
    ------
    ArgumentError
        For a value outside its range.
    """

    sensor_ppm: float = 0.0
    generator_ppm: float = 0.0
    usb_jitter_ms: float = 0.0
    missing_edges: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("sensor_ppm", -1000.0, 1000.0),
            ("generator_ppm", -1000.0, 1000.0),
            ("usb_jitter_ms", 0.0, 1000.0),
            ("missing_edges", 0.0, 1.0),
        ):
            number(name, getattr(self, name), low, high)

    @property
    def sensor_rate(self) -> Fraction:
        """Return sensor time per bench time."""
        return 1 + Fraction(round(self.sensor_ppm * 1000), _PPB)

    @property
    def generator_rate(self) -> Fraction:
        """Return generator time per bench time."""
        return 1 + Fraction(round(self.generator_ppm * 1000), _PPB)
