"""Scan once: camera, laser, stage, reconstruction and scanner, each a process of its own.

ros2 launch eschorty_ros scan.launch.py scene:=sphere speed:=0.02 rviz:=true
ros2 launch eschorty_ros scan.launch.py --show-args
"""

from eschorty_ros.nodes.one_process.launch_arguments import SCAN, scan
from eschorty_ros.nodes.ros.launching import description


def generate_launch_description():
    """Return the description of bench, nodes and, on request, RViz, which ends all when closed."""
    return description(SCAN, scan)
