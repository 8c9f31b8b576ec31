"""A launch description of checked nodes. Needs the packages launch and launch_ros."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    ExecuteProcess,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import EnvironmentVariable
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import ExecutableInPackage

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.base.launcher import launched_environment
from eschorty_ros.nodes.ros.dds import RANGE
from launch import LaunchContext, LaunchDescription

PACKAGE = "eschorty_ros"
NAMESPACE = "eschorty"


def description(arguments: Sequence[Any], check: Callable[[Mapping[str, str]], Any]) -> Any:
    """Return a launch description that starts nothing before ``check`` accepts its arguments.

    It ends, with an exit code that is not 0, when a process of it refuses to run. After a process
    was killed the others go on, and the exit code is not 0 in the end.

    - ``check``: Returns a ``Description`` for the texts of the arguments, or raises.
    """

    def described(context: LaunchContext) -> list[Any]:
        names = [argument.name for argument in arguments]
        _check_names(context.argv, names)
        plan = check({name: context.launch_configurations[name] for name in names})
        return _entities(plan, context.launch_configurations.get("ros_namespace", ""))

    declared = [
        DeclareLaunchArgument(
            argument.name,
            default_value=argument.default,
            description=argument.description,
            choices=list(argument.choices) or None,
        )
        for argument in arguments
    ]
    # On this host alone unless the environment states another range.
    range_ = EnvironmentVariable(RANGE, default_value="LOCALHOST")
    discovery = SetEnvironmentVariable(RANGE, range_)
    return LaunchDescription([discovery, *declared, OpaqueFunction(function=described)])


def _check_names(given: Sequence[str], names: list[str]) -> None:
    """Refuse misspelt arguments, which launch ignores; others may be another launch file's."""
    for name in (text.partition(":=")[0] for text in given if ":=" in text):
        near = get_close_matches(name, names, n=1, cutoff=0.75)
        if name not in names and near:
            raise ArgumentError(f"argument {name} is unknown; did you mean {near[0]}?")


def _entities(plan: Any, pushed: str) -> list[Any]:
    """Return the processes; ``pushed`` is the namespace that an including launch file gives."""
    environment = launched_environment()
    processes = [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=NAMESPACE,
            # Without effect unless ROS_SECURITY_ENABLE is set; see docs/sros2.md.
            ros_arguments=["--enclave", f"/{NAMESPACE}/{name}"],
            # Texts stay texts, also where they could be numbers.
            parameters=[
                {
                    key.replace(f"./{NAMESPACE}/", f".{pushed}/{NAMESPACE}/"): (
                        ParameterValue(value, value_type=str) if isinstance(value, str) else value
                    )
                    for key, value in parameters.items()
                }
            ],
            output="screen",
            emulate_tty=True,
            additional_env=environment,
        )
        for name, parameters in plan.nodes.items()
    ]
    if plan.bench is not None:
        options = [word for name, value in plan.bench.items() for word in (f"--{name}", value)]
        bench = ExecutableInPackage(package=PACKAGE, executable="bench")
        processes.insert(
            0,
            ExecuteProcess(
                cmd=[bench, *options], name="bench", output="screen", additional_env=environment
            ),
        )

    def ended(event: ProcessExited, context: LaunchContext) -> None:
        if event.action not in processes or event.returncode == 0 or context.is_shutdown:
            return
        if event.returncode > 0:
            raise RuntimeError(f"{event.process_name} ended with exit code {event.returncode}")
        context.asyncio_loop.call_exception_handler(
            {"message": f"{event.process_name} was killed by signal {-event.returncode}"}
        )

    entities = [RegisterEventHandler(OnProcessExit(on_exit=ended)), *processes]
    if plan.view:
        view = Node(package="rviz2", executable="rviz2", arguments=["-d", plan.view])
        ending = EmitEvent(event=Shutdown(reason="RViz closed"))
        closed = OnProcessExit(target_action=view, on_exit=[ending])
        entities += [view, RegisterEventHandler(closed)]
    return entities
