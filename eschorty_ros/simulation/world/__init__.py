"""Scene, laser, stage and pixels over sensor time: bytes out, with the truth known."""

from eschorty_ros.simulation.world.effects import Effects
from eschorty_ros.simulation.world.line_on_scene import line_on_scene
from eschorty_ros.simulation.world.recorder import simulate_recording
from eschorty_ros.simulation.world.timeline import Gate, LaserTimeline, SensorControl, StageTimeline
from eschorty_ros.simulation.world.warm_up import warm_up
from eschorty_ros.simulation.world.world import BACKGROUND_HZ, STEP_MM, World

__all__ = [
    "BACKGROUND_HZ",
    "STEP_MM",
    "Effects",
    "Gate",
    "LaserTimeline",
    "SensorControl",
    "StageTimeline",
    "World",
    "line_on_scene",
    "simulate_recording",
    "warm_up",
]
