"""The scan scenarios under launch: the same assertions, the nodes started and ended by launch.

For ``launch_test``; ``test_scan_launch.py`` runs it from pytest.
"""

import os
import signal
import tempfile
import unittest
from pathlib import Path

import launch_testing.actions
import scan_scenarios as scenarios
from launch_processes import TestShutdown, bench_action, node_process

import launch
from eschorty_ros.nodes.ros.domain import free_domain

__all__ = ["TestShutdown"]

LASER_LOG = Path(tempfile.mkdtemp(prefix="laser_")) / "output.log"
DOMAIN = free_domain()
BENCH = Path(tempfile.mkdtemp(prefix="bench_"))


def generate_test_description():
    """Bench and five nodes; the tests find the camera's process by name."""
    nodes = {
        module.rsplit(".", 1)[-1]: node_process(module, parameters, DOMAIN)
        for module, parameters in scenarios.node_parameters(BENCH).items()
    }
    ready = launch_testing.actions.ReadyToTest()
    bench = bench_action(BENCH, scenarios.bench_settings(LASER_LOG))
    arguments = {"camera": nodes["camera"], "laser_log": LASER_LOG}
    return launch.LaunchDescription([bench, *nodes.values(), ready]), arguments


class TestScan(unittest.TestCase):
    """In the order of their names; the camera's death comes last."""

    def setUp(self):
        self._context = scenarios.bench(DOMAIN, LASER_LOG)
        self.bench = self._context.__enter__()

    def tearDown(self):
        self._context.__exit__(None, None, None)

    def test_1_full_scan(self):
        scenarios.full_scan(self.bench)

    def test_2_cancel(self):
        scenarios.cancel_scan(self.bench)

    def test_3_bad_goals_are_refused(self):
        scenarios.bad_goals(self.bench)

    def test_4_bad_parameters_are_refused(self):
        scenarios.bad_parameters(self.bench)

    def test_5_killed_camera_ends_the_scan(self, camera):
        pid = camera.process_details["pid"]
        scenarios.camera_killed(self.bench, lambda: os.kill(pid, signal.SIGKILL))
