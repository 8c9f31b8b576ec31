"""Nodes as the launch tests start them; needs the package launch."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from launch.actions import ExecuteProcess
from ros_process import NAMESPACE, domain_environment

from eschorty_ros.emulation.bench_process import bench_command


def node_process(module: str, parameters: Mapping[str, Any], domain: int) -> ExecuteProcess:
    """One node as launch starts it, named after its module."""
    command = [sys.executable, "-m", module, "--ros-args", "-r", f"__ns:={NAMESPACE}"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={value}"]
    return ExecuteProcess(
        cmd=command,
        name=module.rsplit(".", 1)[-1],
        additional_env=domain_environment(domain),
        output="screen",
    )


def bench_action(folder: Path, settings: Mapping[str, Any]) -> ExecuteProcess:
    """A bench in ``folder`` as launch starts it."""
    options = {name.replace("_", "-"): value for name, value in settings.items()}
    return ExecuteProcess(cmd=bench_command(folder, options), name="bench", output="screen")
