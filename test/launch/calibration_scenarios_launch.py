"""The calibration scenarios under launch: the same assertions, the nodes started by launch.

For ``launch_test``; ``test_scan_launch.py`` runs it from pytest.
"""

import os
import signal
import tempfile
import unittest
from pathlib import Path

import calibration_scenarios as scenarios
import launch_testing.actions
from launch_processes import TestShutdown, bench_action, node_process

import launch
from eschorty_ros.nodes.ros.domain import free_domain

__all__ = ["TestShutdown"]

FOLDER = Path(tempfile.mkdtemp(prefix="calibration_"))
LASER_LOG, MADE = FOLDER / "output.log", FOLDER / "made"
DOMAIN = free_domain()
BENCH = Path(tempfile.mkdtemp(prefix="bench_"))


def generate_test_description():
    """Bench and five nodes; the tests find the camera's process by name."""
    nodes = {
        module.rsplit(".", 1)[-1]: node_process(module, parameters, DOMAIN)
        for module, parameters in scenarios.node_parameters(BENCH, MADE).items()
    }
    ready = launch_testing.actions.ReadyToTest()
    bench = bench_action(BENCH, scenarios.bench_settings(LASER_LOG, "posts"))
    arguments = {"camera": nodes["camera"], "laser_log": LASER_LOG}
    return launch.LaunchDescription([bench, *nodes.values(), ready]), arguments


class TestCalibration(unittest.TestCase):
    """In the order of their names; the camera's death comes last."""

    def setUp(self):
        self._context = scenarios.bench(DOMAIN, LASER_LOG, MADE)
        self.bench = self._context.__enter__()

    def tearDown(self):
        self._context.__exit__(None, None, None)

    def test_1_nine_posts(self):
        scenarios.nine_posts(self.bench, "joint")

    def test_2_bad_goals_are_refused(self):
        scenarios.bad_goals(self.bench)

    def test_3_useless_captures_change_nothing(self):
        scenarios.useless_captures(self.bench)

    def test_4_only_calibrations_of_this_instrument_are_loaded(self):
        folder = FOLDER / "loaded"
        folder.mkdir()
        scenarios.load_and_save(self.bench, folder)

    def test_5_killed_camera_ends_the_calibration(self, camera):
        pid = camera.process_details["pid"]
        scenarios.camera_killed(self.bench, lambda: os.kill(pid, signal.SIGKILL))
