"""Camera, laser, stage, reconstruction and scanner, each a process of its own, and one scan.

ros2 launch eschorty_ros scan.launch.py scene:=sphere speed:=0.02 rviz:=true
ros2 launch eschorty_ros scan.launch.py --show-args
"""

from launch.actions import EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from eschorty_ros.nodes.launching import (
    bench,
    declare,
    driver,
    node,
    number,
    reliable,
    rviz,
    text,
    trigger_input,
)
from launch import LaunchDescription

ARGUMENTS = (
    (
        "fake",
        "true",
        "true: real drivers at an emulated bench; false: at real devices",
        ["true", "false"],
    ),
    (
        "scene",
        "steps",
        "what stands on an emulated bench: steps, plane, tilted, sphere, leaves, face, posts, "
        "receding or a mesh",
        None,
    ),
    ("calibration", "config_3", "optical build: a name in config/ or the path of a file", None),
    (
        "pixels",
        "paper",
        "event pixels of an emulated camera",
        ["paper", "ideal", "noisy", "narrow"],
    ),
    (
        "trigger",
        "stage",
        "what is wired to the camera's trigger input: none, laser or stage",
        ["none", "laser", "stage"],
    ),
    ("frequency", "70.0", "laser modulation, Hz, 16 to 20000: one profile per period", None),
    ("speed", "0.05", "stage speed, m/s", None),
    ("start", "0.01", "stage position where the sweep begins, m", None),
    ("stop", "0.11", "stage position where the sweep ends, m", None),
    ("auto_scan", "true", "true: scan once when every node is ready", ["true", "false"]),
    ("rviz", "false", "true: show cloud, live profile and frames in RViz", ["true", "false"]),
)


def nodes():
    """Make the five nodes with their parameters."""
    parameters = {
        "camera": {
            "driver": driver("evk4"),
            "trigger_in_mode": trigger_input(),
            **reliable("publisher"),
        },
        "laser": {"driver": driver("awg"), "frequency": number("frequency")},
        "stage": {"driver": driver("apt")},
        "reconstruction": {
            "calibration": text("calibration"),
            "trigger_source": text("trigger"),
            **reliable("subscription"),
        },
        "scanner": {
            "auto_scan": ParameterValue(LaunchConfiguration("auto_scan"), value_type=bool),
            "start": number("start"),
            "stop": number("stop"),
            "speed": number("speed"),
        },
    }
    return [node(name, table) for name, table in parameters.items()]


def generate_launch_description():
    """Arguments, bench, nodes; RViz on request, and closing it ends everything."""
    view = rviz()
    ending = OnProcessExit(
        target_action=view, on_exit=[EmitEvent(event=Shutdown(reason="RViz closed"))]
    )
    emulated = bench(scene="scene", calibration="calibration", pixels="pixels", trigger="trigger")
    return LaunchDescription(
        [*declare(ARGUMENTS), emulated, *nodes(), view, RegisterEventHandler(ending)]
    )
