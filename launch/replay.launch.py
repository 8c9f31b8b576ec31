"""Replay a recording to the reconstruction node, without any device.

ros2 launch eschorty_ros replay.launch.py recording:=/path/to/rec rviz:=true
"""

from eschorty_ros.nodes.one_process.launch_arguments import REPLAY, replay
from eschorty_ros.nodes.ros.launching import description


def generate_launch_description():
    """Return the description of replay, reconstruction and, on request, RViz."""
    return description(REPLAY, replay)
