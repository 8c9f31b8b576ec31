"""Camera, laser, stage and reconstruction, each a process of its own, and one calibration.

ros2 launch eschorty_ros calibrate.launch.py method:=paper capture_time:=2
ros2 launch eschorty_ros calibrate.launch.py --show-args
"""

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
    text,
)
from launch import LaunchDescription

ARGUMENTS = (
    FAKE,
    PARAMETERS,
    ("scene", "posts", "what stands on an emulated bench: a scene's name or a mesh", None),
    ("calibration", "config_3", "optical build as designed: a name in config/ or a file", None),
    ("as_built", "config_3_as_built", "build of the emulated bench", None),
    PIXELS,
    TRIGGER,
    ("frequency", "70.0", "laser modulation, Hz, 16 to 20000", None),
    ("distances", "posts", "what is known of the targets: a name in config/ or a CSV file", None),
    ("method", "joint", "what is fitted: k', b' and more under priors, or k' and b' alone",
     ["joint", "paper"]),
    ("capture_time", "1.0", "for how long the targets are lit, s", None),
    ("calibration_folder", "", "where calibrations are written; empty: eschorty in ~/.ros", None),
    ("auto_calibrate", "true", "true: calibrate once when every node is ready; false: wait for "
     "goals of the action calibrate", ["true", "false"]),
)  # fmt: skip


def generate_launch_description():
    """Arguments and nodes."""
    parameters = instrument(
        calibration_folder=text("calibration_folder"),
        distances=text("distances"),
        method=text("method"),
        capture_time=number("capture_time"),
        auto_calibrate=boolean("auto_calibrate"),
    )
    nodes = [node(name, table) for name, table in parameters.items()]
    emulated = bench(scene="scene", calibration="as_built", pixels="pixels", trigger="trigger")
    return LaunchDescription([*declare(ARGUMENTS), emulated, *nodes])
