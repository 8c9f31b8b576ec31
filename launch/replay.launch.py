"""A recording through the reconstruction node, without any device.

ros2 launch eschorty_ros replay.launch.py recording:=/path/to/rec rviz:=true
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import (
    EqualsSubstitution,
    LaunchConfiguration,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

CONFIG = Path(__file__).resolve().parents[1] / "config"
NAMESPACE = "eschorty"
EVENTS = f"/{NAMESPACE}/camera/events"

ARGUMENTS = (
    ("recording", None, "folder with events.raw, stage.csv, laser.yaml, calibration.yaml", None),
    ("rate", "1.0", "speed of the replay against real time; 0 is as fast as possible", None),
    ("rviz", "false", "true: show cloud, live profile and frames in RViz", ["true", "false"]),
)


def generate_launch_description():
    """Arguments, replay and reconstruction; RViz on request."""
    recording = LaunchConfiguration("recording")
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name, default_value=default, description=description, choices=choices
                )
                for name, default, description, choices in ARGUMENTS
            ),
            Node(
                package="eschorty_ros",
                executable="reconstruction",
                name="reconstruction",
                namespace=NAMESPACE,
                parameters=[
                    {
                        "calibration": ParameterValue(
                            PathJoinSubstitution([recording, "calibration.yaml"]), value_type=str
                        ),
                        # A recording's stage track has no gaps that must be refused.
                        "stage_gap": 0.0,
                        f"qos_overrides.{EVENTS}.subscription.reliability": "reliable",
                    }
                ],
                output="screen",
            ),
            Node(
                package="eschorty_ros",
                executable="replay",
                name="replay",
                namespace=NAMESPACE,
                parameters=[
                    {
                        "recording": ParameterValue(recording, value_type=str),
                        "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float),
                        f"qos_overrides.{EVENTS}.publisher.reliability": "reliable",
                    }
                ],
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(CONFIG / "scan.rviz")],
                condition=IfCondition(EqualsSubstitution(LaunchConfiguration("rviz"), "true")),
            ),
        ]
    )
