"""The laser's periods: edges, phase estimate and lock, phase gate."""

from eschorty_ros.core.modulation.modulation import (
    FREQUENCY_MAX_HZ,
    FREQUENCY_MIN_HZ,
    WAVEFORMS,
    Modulation,
)

__all__ = ["FREQUENCY_MAX_HZ", "FREQUENCY_MIN_HZ", "WAVEFORMS", "Modulation"]
