"""Named parameter sets of the pixel model."""

from __future__ import annotations

import math
from types import MappingProxyType

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.simulation.pixels.parameters import PixelParameters

PRESETS = MappingProxyType(
    {
        "paper": PixelParameters(),
        "ideal": PixelParameters(
            threshold_mismatch=0.0,
            follower_hz=math.inf,
            noise=0.0,
            latency_us=0.0,
            latency_jitter_us=0.0,
        ),
        "noisy": PixelParameters(
            threshold_mismatch=0.1,
            noise=0.05,
            refractory_jitter=0.1,
            leak_hz=0.1,
            hot_fraction=1e-5,
            latency_jitter_us=60.0,
        ),
        "narrow": PixelParameters(
            amplitude=8.8,
            sigma_rows=3.94,
            threshold_on=0.274,
            threshold_off=0.274,
            threshold_mismatch=0.03,
            bandwidth_hz=765.0,
            follower_hz=33_000.0,
            noise=0.01,
        ),
    }
)
"""Parameter sets by name.

``paper``
    P*, a fit to what the paper says of its figures (events against frequency, width, shift at a
    reflectance step). Its line is 5 rows wide at 20 kHz, where the paper has 2.
``ideal``
    P* without mismatch, noise, follower, latency and jitter: closed forms hold exactly.
``noisy``
    P* in worse shape: more mismatch, noise and jitter, a leak and hot pixels.
``narrow``
    2 rows at 20 kHz with the same regimes. The price: 60 % more light, a follower 1.65 times
    faster, a comparator four times quieter with less than half the mismatch of P*, and two fifths
    of the events at 20 kHz.
"""


def preset(name: str) -> PixelParameters:
    """Return the parameter set of this name, one of ``PRESETS``.

    Raises ``ArgumentError`` for another name.
    """
    if name not in PRESETS:
        raise ArgumentError(f"pixels is {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]
