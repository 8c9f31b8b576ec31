"""Event pixels: thresholds, bandwidth, noise and biases."""

from eschorty_ros.simulation.pixels.biases import LIMITS, Biases, parameters_from_biases
from eschorty_ros.simulation.pixels.parameters import PixelParameters
from eschorty_ros.simulation.pixels.pixel import PixelArray, unpack
from eschorty_ros.simulation.pixels.presets import PRESETS, preset

__all__ = [
    "LIMITS",
    "PRESETS",
    "Biases",
    "PixelArray",
    "PixelParameters",
    "parameters_from_biases",
    "preset",
    "unpack",
]
