"""Nodes as the launch tests start them; needs the package launch."""

from __future__ import annotations

import signal
import sys
import unittest
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import launch_testing
from launch.actions import ExecuteProcess
from ros_process import NAMESPACE, domain_environment

from eschorty_ros.emulation.bench.process import bench_command


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


@launch_testing.post_shutdown_test()
class TestShutdown(unittest.TestCase):
    """After launch has ended the nodes with SIGINT; the camera was killed before.

    The file that imports it gives the test argument ``laser_log``.
    """

    def test_all_others_exit_cleanly(self, proc_info):
        codes = {info.process_name: info.returncode for info in proc_info}
        assert len(codes) == 6
        for name, code in codes.items():
            assert code == (-signal.SIGKILL if "camera" in name else 0), name

    def test_laser_is_off(self, laser_log):
        assert laser_log.read_text().splitlines()[-1].endswith("OFF")
