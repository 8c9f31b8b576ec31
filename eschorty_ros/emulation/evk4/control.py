"""Register settings of the emulated EVK4 as settings of the simulated sensor."""

from __future__ import annotations

from eschorty_ros.emulation.evk4.settings import SensorSettings
from eschorty_ros.simulation.pixels import LIMITS, Biases
from eschorty_ros.simulation.readout import EventRate
from eschorty_ros.simulation.world import SensorControl


def sensor_control(settings: SensorSettings) -> SensorControl:
    """Biases and event rate of ``settings``; a bias beyond its normal range acts as at its end."""
    offsets = dict(settings.biases)
    biases = {
        name: min(max(offsets[f"bias_{name}"], low), high) for name, (low, high) in LIMITS.items()
    }
    rate = settings.event_rate
    return SensorControl(Biases(**biases), EventRate(*rate) if rate else None)
