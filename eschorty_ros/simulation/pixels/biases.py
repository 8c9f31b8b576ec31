"""The camera's bias settings as parameters of the pixel model.

A model, not a measurement: the sensor's maker publishes direction and range of each bias, but no
numbers of its effect. Each acts by a factor ``exp(bias / scale)``, so that 0 leaves the base
unchanged and the effect is monotone. The high-pass (``bias_hpf``) is not modelled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.simulation.pixels.parameters import PixelParameters

LIMITS = {"diff_on": (-85, 140), "diff_off": (-35, 190), "fo": (-35, 55), "refr": (-20, 235)}
"""Offsets that the IMX636 accepts."""

THRESHOLD_SCALE = 120.0
FOLLOWER_SCALE = 20.0
REFRACTORY_SCALE = -80.0


@dataclass(frozen=True, slots=True)
class Biases:
    """Offsets from the factory setting, in the camera's units.

    Raises ``ArgumentError`` for an offset outside ``LIMITS``.
    """

    diff_on: int = 0
    diff_off: int = 0
    """More raises the ON or OFF threshold: fewer events, a narrower line."""
    fo: int = 0
    """More widens the source follower's band: events are earlier, and more above some kHz."""
    refr: int = 0
    """More shortens the refractory time: more events above 500 Hz."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            low, high = LIMITS[item.name]
            if not low <= value <= high:
                raise ArgumentError(f"{item.name} is {value!r}; choose {low} to {high}")


def parameters_from_biases(base: PixelParameters, biases: Biases) -> PixelParameters:
    """Return the parameters of the pixels of ``base`` under other biases."""
    return replace(
        base,
        threshold_on=base.threshold_on * math.exp(biases.diff_on / THRESHOLD_SCALE),
        threshold_off=base.threshold_off * math.exp(biases.diff_off / THRESHOLD_SCALE),
        follower_hz=base.follower_hz * math.exp(biases.fo / FOLLOWER_SCALE),
        refractory_us=max(1.0, base.refractory_us * math.exp(biases.refr / REFRACTORY_SCALE)),
    )
