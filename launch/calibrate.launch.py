"""Camera, laser, stage and reconstruction, each a process of its own, and one calibration.

ros2 launch eschorty_ros calibrate.launch.py method:=paper capture_time:=2
ros2 launch eschorty_ros calibrate.launch.py --show-args
"""

from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue

from eschorty_ros.nodes.launching import (
    bench,
    declare,
    driver,
    node,
    number,
    reliable,
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
    ("scene", "posts", "what stands on an emulated bench: a scene's name or a mesh", None),
    ("calibration", "config_3", "optical build as designed: a name in config/ or a file", None),
    ("as_built", "config_3_as_built", "build that an emulated bench really has", None),
    ("pixels", "paper", "event pixels of an emulated camera", ["paper", "ideal", "noisy"]),
    ("trigger", "stage", "what is wired to the camera's trigger input: none, laser or stage",
     ["none", "laser", "stage"]),
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
            "calibration_folder": text("calibration_folder"),
            "trigger_source": text("trigger"),
            "distances": text("distances"),
            "method": text("method"),
            "capture_time": number("capture_time"),
            "auto_calibrate": ParameterValue(
                LaunchConfiguration("auto_calibrate"), value_type=bool
            ),
            **reliable("subscription"),
        },
    }
    nodes = [node(name, table) for name, table in parameters.items()]
    emulated = bench(scene="scene", calibration="as_built", pixels="pixels", trigger="trigger")
    return LaunchDescription([*declare(ARGUMENTS), emulated, *nodes])
