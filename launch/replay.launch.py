"""A recording through the reconstruction node, without any device.

ros2 launch eschorty_ros replay.launch.py recording:=/path/to/rec rviz:=true
"""

from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.parameter_descriptions import ParameterValue

from eschorty_ros.nodes.ros.launching import EVENTS, PARAMETERS, declare, node, number, rviz, text
from launch import LaunchDescription

ARGUMENTS = (
    ("recording", None, "folder with events.raw, stage.csv, laser.yaml, calibration.yaml", None),
    ("rate", "1.0", "speed of the replay against real time; 0 is as fast as possible", None),
    PARAMETERS,
    ("rviz", "false", "true: show cloud, live profile and frames in RViz", ["true", "false"]),
)


def generate_launch_description():
    """Arguments, replay and reconstruction; RViz on request."""
    calibration = PathJoinSubstitution([LaunchConfiguration("recording"), "calibration.yaml"])
    reconstruction = {
        "calibration": ParameterValue(calibration, value_type=str),
        # A recording's stage track has no gaps that must be refused.
        "stage_gap": 0.0,
        f"qos_overrides.{EVENTS}.subscription.reliability": "reliable",
    }
    replay = {
        "recording": text("recording"),
        "rate": number("rate"),
    }
    return LaunchDescription(
        [
            *declare(ARGUMENTS),
            node("reconstruction", reconstruction),
            node("replay", replay),
            rviz(),
        ]
    )
