"""Camera, laser, stage, reconstruction and scanner, each a process of its own, and one scan.

ros2 launch eschorty_ros scan.launch.py scene:=sphere speed:=0.02 rviz:=true
ros2 launch eschorty_ros scan.launch.py --show-args
"""

from launch.actions import EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown

from eschorty_ros.nodes.ros.launching import (
    FAKE,
    PARAMETERS,
    PIXELS,
    TRIGGER,
    bench,
    boolean,
    declare,
    instrument,
    node,
    number,
    rviz,
)
from launch import LaunchDescription

ARGUMENTS = (
    FAKE,
    PARAMETERS,
    (
        "scene",
        "steps",
        "what stands on an emulated bench: steps, plane, tilted, sphere, leaves, face, posts, "
        "receding or a mesh",
        None,
    ),
    ("calibration", "config_3", "optical build: a name in config/ or the path of a file", None),
    PIXELS,
    TRIGGER,
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
        **instrument(),
        "scanner": {
            "auto_scan": boolean("auto_scan"),
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
