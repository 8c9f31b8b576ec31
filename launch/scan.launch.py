"""Camera, laser, stage, reconstruction and scanner, each a process of its own, and one scan.

ros2 launch eschorty_ros scan.launch.py scene:=sphere speed:=0.02 rviz:=true
ros2 launch eschorty_ros scan.launch.py --show-args
"""

from pathlib import Path

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    RegisterEventHandler,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import (
    EqualsSubstitution,
    IfElseSubstitution,
    LaunchConfiguration,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

CONFIG = Path(__file__).resolve().parents[1] / "config"
NAMESPACE = "eschorty"
EVENTS = f"/{NAMESPACE}/camera/events"

ARGUMENTS = (
    (
        "fake",
        "true",
        "true: simulated camera, laser and stage; false: real ones",
        ["true", "false"],
    ),
    (
        "scene",
        "steps",
        "what a simulated camera sees: steps, plane, tilted, sphere, leaves, face or a mesh",
        None,
    ),
    ("calibration", "config_3", "optical build: a name in config/ or the path of a file", None),
    ("frequency", "70.0", "laser modulation, Hz, 16 to 20000: one profile per period", None),
    ("speed", "0.05", "stage speed, m/s", None),
    ("start", "0.01", "stage position where the sweep begins, m", None),
    ("stop", "0.11", "stage position where the sweep ends, m", None),
    ("auto_scan", "true", "true: scan once when every node is ready", ["true", "false"]),
    ("rviz", "false", "true: show cloud, live profile and frames in RViz", ["true", "false"]),
)


def number(name):
    """Value of an argument as a float, also when it is written without a decimal point."""
    return ParameterValue(LaunchConfiguration(name), value_type=float)


def text(name):
    """Value of an argument as a string, also when it looks like a number."""
    return ParameterValue(LaunchConfiguration(name), value_type=str)


def driver(real):
    """Choose the simulated device, or the real one's driver."""
    return IfElseSubstitution(LaunchConfiguration("fake"), "fake", real)


def reliable(end):
    """Lossless events at one end; a simulated camera can wait, so nothing has to be lost."""
    if_fake = IfElseSubstitution(LaunchConfiguration("fake"), "reliable", "best_effort")
    return {f"qos_overrides.{EVENTS}.{end}.reliability": if_fake}


def nodes():
    """Make the five nodes with their parameters."""
    parameters = {
        "camera": {
            "driver": driver("evk4"),
            "scene": text("scene"),
            "calibration": text("calibration"),
            **reliable("publisher"),
        },
        "laser": {"driver": driver("awg"), "frequency": number("frequency")},
        "stage": {"driver": driver("apt")},
        "reconstruction": {"calibration": text("calibration"), **reliable("subscription")},
        "scanner": {
            "auto_scan": ParameterValue(LaunchConfiguration("auto_scan"), value_type=bool),
            "start": number("start"),
            "stop": number("stop"),
            "speed": number("speed"),
        },
    }
    return [
        Node(
            package="eschorty_ros",
            executable=name,
            name=name,
            namespace=NAMESPACE,
            parameters=[table],
            output="screen",
            emulate_tty=True,
        )
        for name, table in parameters.items()
    ]


def generate_launch_description():
    """Arguments, nodes; RViz on request, and closing it ends everything."""
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(CONFIG / "scan.rviz")],
        condition=IfCondition(EqualsSubstitution(LaunchConfiguration("rviz"), "true")),
    )
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name, default_value=default, description=description, choices=choices
                )
                for name, default, description, choices in ARGUMENTS
            ),
            *nodes(),
            rviz,
            RegisterEventHandler(
                OnProcessExit(
                    target_action=rviz, on_exit=[EmitEvent(event=Shutdown(reason="RViz closed"))]
                )
            ),
        ]
    )
