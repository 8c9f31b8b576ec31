"""Parameters of the pixel model."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from eschorty_ros.core.base.errors import ArgumentError

_MAY_VANISH = frozenset(
    (
        "threshold_mismatch",
        "noise",
        "refractory_jitter",
        "leak_hz",
        "hot_fraction",
        "hot_hz",
        "latency_us",
        "latency_jitter_us",
    )
)


@dataclass(frozen=True, slots=True)
class PixelParameters:
    """Parameters of the pixel model; the defaults are the preset ``paper``.

    Raises ``ArgumentError`` for a value outside its range.
    """

    background_intensity: float = 1.0
    """Relative photocurrent ``I_bg`` without the laser."""
    amplitude: float = 5.5
    """Photocurrent ``A`` the line adds at its centre on a surface of reflectance 1."""
    sigma_rows: float = 4.1
    """Gaussian width of the line on the sensor, rows."""
    threshold_on: float = 0.25
    threshold_off: float = 0.25
    """Comparator thresholds in log intensity."""
    threshold_mismatch: float = 0.08
    """Relative standard deviation of a pixel's thresholds, fixed per pixel."""
    threshold_min: float = 0.03
    """Least threshold any pixel has."""
    bandwidth_hz: float = 1000.0
    """Photoreceptor bandwidth at ``I = 1``; proportional to ``I``."""
    follower_hz: float = 20_000.0
    """Pole of the source follower; ``inf`` for none."""
    noise: float = 0.04
    """Standard deviation of the signal behind the follower, in log intensity."""
    refractory_us: float = 700.0
    refractory_jitter: float = 0.0
    """Refractory time, and its relative standard deviation, drawn per event."""
    leak_hz: float = 0.0
    """ON events per second of any pixel, lit or not, from its reference leaking away. The 0.1 Hz of
    P* are left to the background activity, of which they are a part."""
    hot_fraction: float = 0.0
    hot_hz: float = 100.0
    """Share of pixels that fire without light changes, ON and OFF alike; events per second of
    one."""
    latency_us: float = 100.0
    latency_jitter_us: float = 30.0
    """Mean and standard deviation from crossing to readout request; never below 1 us."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            least = 0.0 if item.name in _MAY_VANISH else 1e-9
            finite = math.isfinite(value) or (item.name == "follower_hz" and value == math.inf)
            if not (finite and value >= least):
                raise ArgumentError(f"{item.name} is {value!r}; choose a positive number")
        if self.hot_fraction > 1.0:
            raise ArgumentError(f"hot_fraction is {self.hot_fraction!r}; choose 0 to 1")
        if self.refractory_us < 1.0:
            raise ArgumentError(f"refractory_us is {self.refractory_us!r}; choose 1 us or more")

    @property
    def omega_per_us(self) -> float:
        """Photoreceptor rate ``omega0 = 2 pi f3`` at ``I = 1``, per us."""
        return 2.0 * math.pi * self.bandwidth_hz * 1e-6

    @property
    def follower_us(self) -> float:
        """Time constant of the source follower, us."""
        return max(1e6 / (2.0 * math.pi * self.follower_hz), 1e-6)

    @property
    def least_contrast(self) -> float:
        """Contrast that causes an event with negligible probability; dimmer rows are not drawn.

        It reaches a threshold four sigma of mismatch low with three sigma of noise, and at most
        60 % of it: a row that comes into the light must not be late for its first event.
        """
        lowest = min(self.threshold_on, self.threshold_off) * (1.0 - 4.0 * self.threshold_mismatch)
        swing = lowest - max(3.0 * self.noise, 0.4 * lowest)
        return self.background_intensity * math.expm1(max(swing, self.threshold_min))

    @property
    def half_width_rows(self) -> float:
        """Rows from the line's centre to the last that is drawn, on a surface of reflectance 1."""
        ratio = self.amplitude / self.least_contrast
        return self.sigma_rows * math.sqrt(2.0 * math.log(ratio)) if ratio > 1.0 else 0.0
