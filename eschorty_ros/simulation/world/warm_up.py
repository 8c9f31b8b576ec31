"""Compiling the pixel kernels before a simulated camera streams."""

from __future__ import annotations

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration
from eschorty_ros.simulation.pixels import Biases
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world.timeline import SensorControl
from eschorty_ros.simulation.world.world import World


def warm_up(calibration: Calibration) -> None:
    """Simulate a millisecond of a lit plane, with a change of biases, in a world of its own.

    The first run on a machine compiles for some seconds; later runs load numba's cache. Without it
    a simulated camera stops for seconds at its first light.
    """
    world = World(named("plane", calibration.model()), calibration)
    world.set_laser(0, True, Modulation(1000.0, on_edge_us=0))
    world.set_sensor(500, SensorControl(Biases(diff_on=1)))
    world.advance(1000)
