"""The common part of the launch files. Needs the packages launch and launch_ros."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, ExecuteProcess, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import (
    EnvironmentVariable,
    EqualsSubstitution,
    IfElseSubstitution,
    LaunchConfiguration,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import ExecutableInPackage

from eschorty_ros.core.base.files import config_folders

NAMESPACE = "eschorty"
EVENTS = f"/{NAMESPACE}/camera/events"

Argument = tuple[str, str | None, str, list[str] | None]
"""Name, default (``None``: must be given), description, choices."""


def _config_file(name: str) -> Path:
    paths = [folder / name for folder in config_folders()]
    return next((path for path in paths if path.is_file()), Path(name))


FAKE: Argument = (
    "fake",
    "true",
    "true: real drivers at an emulated bench; false: at real devices",
    ["true", "false"],
)
TRIGGER: Argument = (
    "trigger",
    "stage",
    "what is wired to the camera's trigger input: none, laser or stage",
    ["none", "laser", "stage"],
)
PIXELS: Argument = (
    "pixels",
    "paper",
    "event pixels of an emulated camera",
    ["paper", "ideal", "noisy", "narrow"],
)
PARAMETERS: Argument = (
    "parameters",
    str(_config_file("parameters.yaml")),
    "YAML file of parameters by node; what it holds overrides the other arguments",
    None,
)


def declare(arguments: tuple[Argument, ...]) -> list[Any]:
    """Return launch arguments from a table, and the discovery on this host alone by default.

    ``ROS_AUTOMATIC_DISCOVERY_RANGE`` in the environment changes that.
    """
    discovery = "ROS_AUTOMATIC_DISCOVERY_RANGE"
    range_ = EnvironmentVariable(discovery, default_value="LOCALHOST")
    return [SetEnvironmentVariable(discovery, range_)] + [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, default, text, choices in arguments
    ]


def number(name: str) -> Any:
    """Return an argument's value as a float, also without a decimal point."""
    return ParameterValue(LaunchConfiguration(name), value_type=float)


def text(name: str) -> Any:
    """Return an argument's value as a string, also if it could be a number."""
    return ParameterValue(LaunchConfiguration(name), value_type=str)


def boolean(name: str) -> Any:
    """Return the value of an argument that is true or false."""
    return ParameterValue(LaunchConfiguration(name), value_type=bool)


def instrument(**reconstruction: Any) -> dict[str, dict[str, Any]]:
    """Return parameters of devices and reconstruction by node, from arguments of their names.

    At an emulated bench the events are reliable at both ends, because its camera can wait.
    """
    fake = LaunchConfiguration("fake")
    reliability = IfElseSubstitution(fake, "reliable", "best_effort")
    unwired = EqualsSubstitution(LaunchConfiguration("trigger"), "none")
    return {
        "camera": {
            "driver": IfElseSubstitution(fake, "fake", "evk4"),
            "trigger_in_mode": IfElseSubstitution(unwired, "disabled", "external"),
            f"qos_overrides.{EVENTS}.publisher.reliability": reliability,
        },
        "laser": {
            "driver": IfElseSubstitution(fake, "fake", "awg"),
            "frequency": number("frequency"),
        },
        "stage": {"driver": IfElseSubstitution(fake, "fake", "apt")},
        "reconstruction": {
            "calibration": text("calibration"),
            "trigger_source": text("trigger"),
            **reconstruction,
            f"qos_overrides.{EVENTS}.subscription.reliability": reliability,
        },
    }


def bench(**options: str) -> Any:
    """Return the process of the emulated devices, started when the argument ``fake`` is true.

    ``options`` maps options of ``eschorty-bench`` to the launch arguments that give them.
    """
    command: list[Any] = [ExecutableInPackage(package="eschorty_ros", executable="bench")]
    for option, argument in options.items():
        command += [f"--{option}", LaunchConfiguration(argument)]
    return ExecuteProcess(
        cmd=command,
        name="bench",
        output="screen",
        condition=IfCondition(EqualsSubstitution(LaunchConfiguration("fake"), "true")),
    )


def node(executable: str, parameters: dict[str, Any]) -> Any:
    """Return a node named as its executable; the parameter file overrides ``parameters``."""
    return Node(
        package="eschorty_ros",
        executable=executable,
        name=executable,
        namespace=NAMESPACE,
        # Without effect unless ROS_SECURITY_ENABLE is set; see docs/sros2.md.
        ros_arguments=["--enclave", f"/{NAMESPACE}/{executable}"],
        parameters=[parameters, ParameterFile(LaunchConfiguration("parameters"))],
        output="screen",
        emulate_tty=True,
    )


def rviz() -> Any:
    """Return RViz with the package's view, started when the argument ``rviz`` is true."""
    return Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(_config_file("scan.rviz"))],
        condition=IfCondition(EqualsSubstitution(LaunchConfiguration("rviz"), "true")),
    )
