"""Calibrate once: camera, laser, stage and reconstruction, each a process of its own.

ros2 launch eschorty_ros calibrate.launch.py method:=paper capture_time:=2
ros2 launch eschorty_ros calibrate.launch.py --show-args
"""

from eschorty_ros.nodes.one_process.launch_arguments import CALIBRATE, calibrate
from eschorty_ros.nodes.ros.launching import description


def generate_launch_description():
    """Return the description of bench and nodes."""
    return description(CALIBRATE, calibrate)
