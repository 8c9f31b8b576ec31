"""Two scan scenarios under launch: the same assertions, the nodes started and ended by launch.

For ``launch_test``; ``test_scan_launch.py`` runs it from pytest.
"""

import os
import signal
import sys
import tempfile
import unittest
from pathlib import Path

import launch_testing
import launch_testing.actions
import scan_scenarios as scenarios
from launch.actions import ExecuteProcess
from ros_process import NAMESPACE, domain_environment, node_name

import launch
from eschorty_ros.emulation.bench.process import bench_command
from eschorty_ros.nodes.ros.domain import free_domain

LASER_LOG = Path(tempfile.mkdtemp(prefix="laser_")) / "output.log"
DOMAIN = free_domain()
BENCH = Path(tempfile.mkdtemp(prefix="bench_"))


def node_process(module, parameters):
    """One node as launch starts it."""
    command = [sys.executable, "-m", module, "--ros-args", "-r", f"__ns:={NAMESPACE}"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={value}"]
    environment = domain_environment(DOMAIN)
    return ExecuteProcess(
        cmd=command, name=node_name(module), additional_env=environment, output="screen"
    )


def generate_test_description():
    """Bench and five nodes; the tests find the camera's process by name."""
    settings = scenarios.bench_settings(LASER_LOG).items()
    options = {name.replace("_", "-"): value for name, value in settings}
    bench = ExecuteProcess(cmd=bench_command(BENCH, options), name="bench", output="screen")
    nodes = {
        node_name(module): node_process(module, parameters)
        for module, parameters in scenarios.node_parameters(BENCH).items()
    }
    ready = launch_testing.actions.ReadyToTest()
    return launch.LaunchDescription([bench, *nodes.values(), ready]), {"camera": nodes["camera"]}


class TestScan(unittest.TestCase):
    """In the order of their names; the camera's death comes last."""

    def setUp(self):
        self.bench = self.enterContext(scenarios.bench(DOMAIN, LASER_LOG))

    def test_1_full_scan(self):
        scenarios.full_scan(self.bench)

    def test_2_killed_camera_ends_the_scan(self, camera):
        pid = camera.process_details["pid"]
        scenarios.camera_killed(self.bench, lambda: os.kill(pid, signal.SIGKILL))


@launch_testing.post_shutdown_test()
class TestShutdown(unittest.TestCase):
    """After launch has ended the nodes with SIGINT; the camera was killed before."""

    def test_all_others_exit_cleanly(self, proc_info):
        codes = {info.process_name: info.returncode for info in proc_info}
        assert len(codes) == 6
        for name, code in codes.items():
            assert code == (-signal.SIGKILL if "camera" in name else 0), name

    def test_laser_is_off(self):
        assert LASER_LOG.read_text().splitlines()[-1].endswith("OFF")
