"""An emulated Prophesee EVK4."""

from eschorty_ros.emulation.evk4.model import CONTROL_IN, CONTROL_OUT, DATA_IN, Evk4Model
from eschorty_ros.emulation.evk4.sequences import SEQUENCES, Phase
from eschorty_ros.emulation.evk4.settings import SensorSettings
from eschorty_ros.emulation.evk4.treuzell import BoardIdentity

__all__ = [
    "CONTROL_IN",
    "CONTROL_OUT",
    "DATA_IN",
    "SEQUENCES",
    "BoardIdentity",
    "Evk4Model",
    "Phase",
    "SensorSettings",
]
